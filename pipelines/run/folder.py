"""The run folder: the only module that knows paths inside a run.

    video.msgs/
      run.toml        the complete settings
      manifest.json   source; stage → fingerprint, files with sizes and checksums, settings, seconds, figures, warnings
      frames/  proxy/  tracking/  mapping/  global_ba/  export/
      <stage>.partial/   unfinished; renamed only when the stage ends well

A reader (`load_*`) looks in finished stages, and at files only that are still what the stage left. A writer (`save_*`)
is given the folder of the running stage.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import count, takewhile
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.atomic import atomic_path
from msgs_slam.formats.images import read_grey_png, read_rgb, write_grey_png
from msgs_slam.formats.jsonfile import read_json, read_json_object, write_json
from msgs_slam.formats.tensors import load_tensors, save_arrays, save_tensors
from msgs_slam.pipelines.depth.fields import FINE, DepthFields
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.run import layouts
from msgs_slam.pipelines.run.finished_files import FinishedFiles
from msgs_slam.pipelines.run.layouts import dataclass_from_json, load_layout, reading
from msgs_slam.pipelines.run.proxy_files import load_proxy_maps, proxy_name
from msgs_slam.pipelines.run.sparse_files import load_sparse_model, save_sparse_model
from msgs_slam.pipelines.types import (
    VOID,
    Calibration,
    ClassTable,
    Features,
    Frame,
    LoopEdge,
    ProxyMaps,
    Trajectory,
    Vocabulary,
    any_of,
)

if TYPE_CHECKING:
    from msgs_slam.pipelines.gaussian_map import GaussianMap

FRAMES, CALIBRATION, BACKBONE = "frames.json", "calibration.json", "backbone/model.npz"
VOCABULARY, TRIED = "correspondence/vocabulary.npz", "correspondence/tried.npz"
CLASSES, DESCRIPTORS = "classes.json", "descriptors.npz"
TRAJECTORY, SPARSE, DEPTH_FIELDS = "trajectory.npz", "sparse.npz", "depth_fields.npz"
MAP, EXPOSURE, LOOPS = "map.safetensors", "exposure.npz", "loops.json"
MESH, WORLD, SCALE = "mesh.ply", "world.json", "scale.json"


@dataclass(frozen=True)
class RunFolder(FinishedFiles):
    """One run on disk: what its finished stages have left."""

    # frames -----------------------------------------------------------------------------------------------------

    def load_frames(self) -> list[Frame]:
        """All picked frames in order."""
        path = self.file("frames", FRAMES)
        rows = read_json(path, None)
        with reading(path, "table of frames"):
            frames = [dataclass_from_json(Frame, row) for row in rows]
            if [f.id for f in frames] != list(range(len(frames))):
                raise ValueError("the frames are not counted from 0")
            return frames

    def load_calibration(self) -> Calibration:
        """The camera of the undistorted frames."""
        path = self.file("frames", CALIBRATION)
        value = read_json(path, None)
        with reading(path, "calibration"):
            return dataclass_from_json(Calibration, value)

    def load_backbone(self) -> SparseModel | None:
        """Keyframes and points of structure from motion over the frames; None where it found none."""
        return load_sparse_model(self.file("frames", BACKBONE)) if self.has("frames", BACKBONE) else None

    def image_file(self, frame: Frame) -> Path:
        """The image of a frame, undistorted."""
        return self.file("frames", frame.name)

    def load_features(self, frame_id: int) -> Features | None:
        """Features of a keyframe in undistorted pixels; None for any other frame."""
        name = features_name(frame_id)
        return (
            Features(**load_layout(self.file("frames", name), layouts.FEATURES)) if self.has("frames", name) else None
        )

    def load_vocabulary(self) -> Vocabulary:
        """By which frames are described and compared."""
        return Vocabulary(**load_layout(self.file("frames", VOCABULARY), layouts.VOCABULARY))

    def load_matched_pairs(self) -> dict[tuple[int, int], int]:
        """Pairs that were matched: see `save_matching`."""
        rows = load_layout(self.file("frames", TRIED), layouts.TRIED)["rows"]
        return {(first, second): matches for first, second, matches in rows.tolist()}

    def image(self, frame: Frame) -> NDArray[np.uint8]:
        """(H, W, 3) RGB, undistorted."""
        return read_rgb(self.image_file(frame))

    def left_out(self, frame: Frame) -> NDArray[np.bool_] | None:
        """(H, W) what of the undistorted frame is no part of the scene; None where all of it is."""
        return any_of(self.mask(frame, stage) for stage in ("frames", "proxy"))

    def mask(self, frame: Frame, stage: str) -> NDArray[np.bool_] | None:
        """(H, W) what a stage leaves out of the undistorted frame; None for nothing."""
        name = f"masks/{frame.name}.png"
        return read_grey_png(self.file(stage, name)) == 0 if self.has(stage, name) else None

    # proxy ------------------------------------------------------------------------------------------------------

    def load_classes(self) -> ClassTable:
        """Names and colours of the labels."""
        path = self.file("proxy", CLASSES)
        rows = read_json(path, None)
        with reading(path, "table of classes"):
            colors = [(int(r), int(g), int(b)) for r, g, b in (row["color"] for row in rows)]
            if not all(0 <= value <= 255 for color in colors for value in color):
                raise ValueError("a colour is outside 0..255")
            return ClassTable(tuple(str(row["name"]) for row in rows), tuple(colors))

    def load_proxy_report(self) -> dict[str, Any]:
        """{"depth": provider, "semantics": provider, "metric": bool, ...}."""
        return read_json_object(self.file("proxy", "proxy.json"))

    def has_proxy(self, frame_id: int) -> bool:
        """Whether the frame has proxy maps."""
        return self.has("proxy", proxy_name(frame_id))

    def load_proxy(self, frame_id: int) -> ProxyMaps:
        """Proxy maps of one frame; InputError when it has none."""
        return load_proxy_maps(self.file("proxy", proxy_name(frame_id)))

    def find_proxy(self, frame_id: int) -> ProxyMaps | None:
        """Proxy maps of one frame, None when it has none."""
        return self.load_proxy(frame_id) if self.has_proxy(frame_id) else None

    def load_descriptors(self) -> dict[int, NDArray[np.float32]]:
        """Frame id → (F,) global descriptor of a network, a unit vector; {} where none gave one."""
        if not self.has("proxy", DESCRIPTORS):
            return {}
        arrays = load_layout(self.file("proxy", DESCRIPTORS), layouts.DESCRIPTORS)
        return dict(zip(arrays["frame_ids"].tolist(), arrays["vectors"], strict=True))

    # tracking, mapping, global_ba -------------------------------------------------------------------------------

    def pieces(self, stage: str) -> list[str]:
        """Folders inside `stage` ("frames", "tracking") of the disconnected components, largest first."""
        return list(takewhile(lambda piece: self.has(stage, f"{piece}/{SPARSE}"), (f"piece_{n}" for n in count(2))))

    def load_trajectory(self, stage: str, piece: str = "") -> Trajectory:
        """The poses as `stage` ("tracking", "mapping" or "global_ba") left them."""
        path = self.file(stage, str(PurePosixPath(piece, TRAJECTORY)))
        arrays = load_layout(path, layouts.TRAJECTORY)
        with reading(path, "trajectory"):
            layouts.require_increasing("frame_ids", arrays["frame_ids"])
            layouts.require_rigid("the poses", arrays["cam_from_world"])
            reasons = tuple(str(r) for r in arrays.pop("lost_reasons"))
            return Trajectory(**arrays, lost_reasons=reasons)

    def has_sparse(self, stage: str) -> bool:
        """Whether `stage` has left points."""
        return self.has(stage, SPARSE)

    def load_sparse(self, stage: str, piece: str = "") -> SparseModel:
        """Keyframe poses and points as `stage` left them."""
        return load_sparse_model(self.file(stage, str(PurePosixPath(piece, SPARSE))))

    def load_depth_fields(self, stage: str) -> DepthFields:
        """Load the fields that bring proxy depths into the world of `stage`, tracking or global_ba."""
        path = self.file(stage, DEPTH_FIELDS)
        arrays = load_layout(path, layouts.DEPTH_FIELDS)
        with reading(path, "file of depth fields"):
            layouts.require_increasing("frame_ids", arrays["frame_ids"])
        return DepthFields(dict(zip(arrays["frame_ids"].tolist(), arrays["log_scales"], strict=True)))

    def has_exposure(self, stage: str) -> bool:
        """Whether `stage` has left exposures."""
        return self.has(stage, EXPOSURE)

    def load_exposure(self, stage: str = "mapping") -> dict[str, NDArray]:
        """frame_ids (N,), log_gains (N, 3), offsets (N, 3) of the mapped keyframes."""
        return load_layout(self.file(stage, EXPOSURE), layouts.EXPOSURE)

    def load_map(self, stage: str, device: str = "cpu") -> GaussianMap:
        """The Gaussian map as `stage` left it."""
        return read_map(self.file(stage, MAP), device)

    def load_class_ids(self) -> tuple[int, ...]:
        """The label of each class channel of the map."""
        with reading(path := self.file("mapping", "mapping.json"), "table of class channels"):
            ids = tuple(int(i) for i in read_json_object(path, None)["class_ids"])
            layouts.require_indices("class_ids", np.array(ids, np.int64), VOID)
            return ids

    def load_submaps(self) -> list[dict[str, NDArray[np.int64]]]:
        """Load each submap's frame ids "own" and "border" and its neighbours "beside"; [] for an undivided map."""
        with reading(path := self.file("mapping", "mapping.json"), "table of submaps"):
            rows = read_json_object(path, None).get("submaps", [])
            return [{k: np.array(row[k], np.int64).reshape(-1) for k in ("own", "border", "beside")} for row in rows]

    def load_loops(self) -> list[LoopEdge]:
        """The verified loops of the global adjustment."""
        path = self.file("global_ba", LOOPS)
        rows = read_json(path, None)
        with reading(path, "table of loops"):
            edges = [dataclass_from_json(LoopEdge, row) for row in rows]
            for edge in edges:
                layouts.require_rigid("a loop", edge.frame2_from_frame1)
            return edges


# writers: pure functions of a folder and a value ----------------------------------------------------------------


def read_map(path: Path, device: str = "cpu") -> GaussianMap:
    """Read a Gaussian map onto a device. Raises InputError for a damaged one."""
    from msgs_slam.pipelines.gaussian_map import GaussianMap  # imports torch, and few who read a run need it

    tensors = load_tensors(path)
    with reading(path, "Gaussian map"):
        if not all(bool(t.isfinite().all()) for t in tensors.values()):
            raise ValueError("it holds numbers that are not finite")
        return GaussianMap(**{name: tensor.to(device) for name, tensor in tensors.items()})


def save_frames(folder: Path, frames: list[Frame]) -> None:
    """The table of frames, and their timestamps as text for other programs."""
    write_json(folder / FRAMES, [asdict(f) for f in frames])
    with atomic_path(folder / "timestamps.txt") as temporary:
        temporary.write_text("".join(f"{f.name} {f.timestamp:.9f}\n" for f in frames), encoding="utf-8")


def save_left_out(folder: Path, frame: Frame, left_out: NDArray[np.bool_]) -> None:
    """NAME.png, as COLMAP reads masks: black is left out."""
    folder.mkdir(parents=True, exist_ok=True)
    write_grey_png(folder / f"{frame.name}.png", np.where(left_out, 0, 255).astype(np.uint8))


def load_left_out(folder: Path, frame: Frame) -> NDArray[np.bool_] | None:
    """Inverse of `save_left_out`; None where there is none."""
    path = folder / f"{frame.name}.png"
    return read_grey_png(path) == 0 if path.exists() else None


def save_calibration(folder: Path, calibration: Calibration) -> None:
    """The camera of the undistorted frames."""
    write_json(folder / CALIBRATION, asdict(calibration))


def save_features(folder: Path, frame_id: int, features: Features) -> None:
    """One npz a keyframe."""
    save_arrays(folder / features_name(frame_id), vars(features))


def features_name(frame_id: int) -> str:
    """Return the path of a keyframe's features inside the stage's folder."""
    return f"correspondence/{frame_id:06d}.npz"


def save_matching(folder: Path, vocabulary: Vocabulary, tried: dict[tuple[int, int], int]) -> None:
    """tried: (first, second) frame ids of every pair of keyframes that was matched → matches that obey one geometry."""
    save_arrays(folder / VOCABULARY, vars(vocabulary))
    rows = np.array([(*pair, count) for pair, count in tried.items()], np.int64).reshape(-1, 3)
    save_arrays(folder / TRIED, {"rows": rows})


def save_backbone(folder: Path, model: SparseModel) -> None:
    """Write the structure-from-motion model over the frames."""
    save_sparse_model(folder / BACKBONE, model)


def save_sparse(folder: Path, model: SparseModel) -> None:
    """Keyframe poses and points of tracking or of the global adjustment."""
    save_sparse_model(folder / SPARSE, model)


def save_figures(folder: Path, stage: str, figures: dict[str, Any]) -> None:
    """Write the figures of a stage's result as JSON, for other programs."""
    write_json(folder / f"{stage}.json", figures)


def save_classes(folder: Path, classes: ClassTable) -> None:
    """Write the class table as [{"id", "name", "color"}]."""
    rows = [
        {"id": i, "name": n, "color": list(c)}
        for i, (n, c) in enumerate(zip(classes.names, classes.colors, strict=True))
    ]
    write_json(folder / CLASSES, rows)


def save_frame_scales(folder: Path, scales: dict[int, float], spreads: dict[int, float]) -> None:
    """[{"frame_id", "scale", "spread"}]: proxy depth over the depth of the backbone's points, and how its own points
    stray from that, relatively."""
    rows = [{"frame_id": i, "scale": round(s, 6), "spread": round(spreads[i], 6)} for i, s in scales.items()]
    write_json(folder / "frame_scales.json", rows)


def save_descriptors(folder: Path, vectors: dict[int, NDArray[np.float32]]) -> None:
    """One npz; nothing where there are none."""
    if vectors:
        ids = np.array(list(vectors), np.int64)
        save_arrays(folder / DESCRIPTORS, {"frame_ids": ids, "vectors": np.stack(list(vectors.values()))})


def save_trajectory(folder: Path, trajectory: Trajectory) -> None:
    """Write the trajectory as one npz."""
    arrays = dict(trajectory.__dict__)
    arrays["lost_reasons"] = np.array(trajectory.lost_reasons, dtype=np.str_)
    save_arrays(folder / TRAJECTORY, arrays)


def save_map(folder: Path, gaussian_map: GaussianMap) -> None:
    """Write the Gaussian map as one safetensors file."""
    save_tensors(folder / MAP, {k: v.detach().cpu().contiguous() for k, v in vars(gaussian_map).items()})


def save_depth_fields(folder: Path, fields: DepthFields) -> None:
    """depth_fields.npz: frame_ids (N,), log_scales (N, rows, columns)."""
    logs = np.array(list(fields.of_frame.values())).reshape(-1, FINE.rows, FINE.columns)
    save_arrays(folder / DEPTH_FIELDS, {"frame_ids": np.array(list(fields.of_frame), np.int64), "log_scales": logs})


def save_exposure(
    folder: Path, frame_ids: NDArray[np.int64], log_gains: NDArray[np.float32], offsets: NDArray[np.float32]
) -> None:
    """image = colours of the map * exp(log gain) + offset, a keyframe and channel."""
    save_arrays(folder / EXPOSURE, {"frame_ids": frame_ids, "log_gains": log_gains, "offsets": offsets})


def save_loops(folder: Path, loops: list[LoopEdge]) -> None:
    """Write the verified loops as JSON."""
    rows = [{**vars(e), "frame2_from_frame1": e.frame2_from_frame1.tolist()} for e in loops]
    write_json(folder / LOOPS, rows)
