"""The run folder: the only module that knows paths inside a run.

    video.msgs/
      run.toml        the complete settings
      manifest.json   stage → fingerprint, files with sizes and checksums, seconds, figures, warnings
      frames/  proxy/  tracking/  mapping/  global_ba/  export/
      <stage>.partial/   unfinished; renamed only when the stage ends well

A reader (`load_*`) looks in finished stages. A writer (`save_*`) is given the folder of the running stage.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from formats.atomic import atomic_path, write_text
from formats.errors import InputError
from formats.images import read_rgb
from formats.jsonfile import write_json
from formats.tensors import load_arrays, load_tensors, save_arrays, save_tensors
from pipelines.config import Config, config_to_toml
from pipelines.gaussian_map import GaussianMap
from pipelines.types import (
    Calibration,
    ClassTable,
    Frame,
    Intrinsics,
    LoopEdge,
    MirrorPairs,
    ProxyMaps,
    SparseModel,
    Trajectory,
)


def read_json(path: Path) -> Any:
    """Raises InputError when the file is missing or torn."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); `msgs-slam resume` makes it again") from error
    except ValueError as error:
        raise InputError(f"{path}: is damaged ({error}); delete it and `msgs-slam resume` makes it again") from error


@dataclass(frozen=True)
class RunFolder:
    """One run on disk."""

    root: Path

    def stage(self, name: str) -> Path:
        """Folder of a finished stage."""
        return self.root / name

    def partial(self, name: str) -> Path:
        """Folder of an unfinished stage."""
        return self.root / f"{name}.partial"

    @property
    def settings_file(self) -> Path:
        return self.root / "run.toml"

    @property
    def manifest_file(self) -> Path:
        return self.root / "manifest.json"

    # frames -----------------------------------------------------------------------------------------------------

    def load_frames(self) -> list[Frame]:
        """All picked frames in order."""
        return [Frame(**row) for row in read_json(self.stage("frames") / "frames.json")]

    def load_calibration(self) -> Calibration:
        """The camera of the undistorted frames."""
        return calibration_from_json(read_json(self.stage("frames") / "calibration.json"))

    def load_backbone(self) -> SparseModel | None:
        """Keyframes and points of structure from motion over the frames; None where it found none."""
        path = self.stage("frames") / "backbone" / "model.npz"
        return load_sparse_model(path) if path.exists() else None

    def image(self, frame: Frame) -> NDArray[np.uint8]:
        """(H, W, 3) RGB, undistorted."""
        return read_rgb(self.stage("frames") / frame.name)

    # proxy ------------------------------------------------------------------------------------------------------

    def load_classes(self) -> ClassTable:
        """Names and colours of the labels."""
        rows = read_json(self.stage("proxy") / "classes.json")
        return ClassTable(tuple(r["name"] for r in rows), tuple(tuple(r["color"]) for r in rows))

    def load_proxy_report(self) -> dict[str, Any]:
        """{"depth": provider, "semantics": provider, "metric": bool, ...}."""
        return read_json(self.stage("proxy") / "proxy.json")

    def has_proxy(self, frame_id: int) -> bool:
        """Whether the frame has proxy maps."""
        return proxy_path(self.stage("proxy"), frame_id).exists()

    def load_proxy(self, frame_id: int) -> ProxyMaps:
        """Proxy maps of one frame; InputError when it has none."""
        return load_proxy_maps(proxy_path(self.stage("proxy"), frame_id))

    def load_symmetry(self) -> dict[int, MirrorPairs]:
        """Frame id → pairs of pixels that show each other's mirror image; {} where no symmetry was found."""
        path = self.stage("proxy") / "symmetry.npz"
        return load_mirror_pairs(path) if path.exists() else {}

    def load_descriptors(self) -> dict[int, NDArray[np.float32]]:
        """Frame id → (F,) unit vector by which a network tells how the frame looks; {} where none did."""
        path = self.stage("proxy") / "descriptors.npz"
        if not path.exists():
            return {}
        arrays = load_arrays(path)
        return dict(zip(arrays["frame_ids"].tolist(), arrays["vectors"], strict=True))

    # tracking, mapping, global_ba -------------------------------------------------------------------------------

    def load_trajectory(self, stage: str) -> Trajectory:
        """The poses as `stage` ("tracking", "mapping" or "global_ba") left them."""
        arrays = load_arrays(self.stage(stage) / "trajectory.npz")
        reasons = tuple(str(r) for r in arrays.pop("lost_reasons"))
        return Trajectory(**arrays, lost_reasons=reasons)

    def load_sparse(self, stage: str) -> SparseModel:
        """Keyframe poses and points as `stage` left them."""
        return load_sparse_model(self.stage(stage) / "sparse.npz")

    def load_depth_scales(self) -> dict[str, NDArray] | None:
        """frame_ids, scales, grids: depth in the world over proxy depth; None where tracking left none."""
        path = self.stage("tracking") / "depth_scales.npz"
        return load_arrays(path) if path.exists() else None

    def load_exposure(self) -> dict[str, NDArray]:
        """frame_ids (N,), log_gains (N, 3), offsets (N, 3) of the mapped keyframes."""
        return load_arrays(self.stage("mapping") / "exposure.npz")

    def load_map(self, stage: str, device: str = "cpu") -> GaussianMap:
        """The Gaussian map as `stage` left it."""
        tensors = load_tensors(self.stage(stage) / "map.safetensors")
        return GaussianMap(**{name: tensor.to(device) for name, tensor in tensors.items()})

    def load_loops(self) -> list[LoopEdge]:
        """The verified loops of the global adjustment."""
        rows = read_json(self.stage("global_ba") / "loops.json")
        return [LoopEdge(**{**r, "frame2_from_frame1": np.array(r["frame2_from_frame1"])}) for r in rows]


def save_settings(run: RunFolder, config: Config) -> None:
    """run.toml. Raises InputError when the disk refuses."""
    write_text(run.settings_file, config_to_toml(config))


# writers: pure functions of a folder and a value ----------------------------------------------------------------


def save_frames(folder: Path, frames: list[Frame]) -> None:
    """The table of frames, and their timestamps as text for other programs."""
    write_json(folder / "frames.json", [asdict(f) for f in frames])
    with atomic_path(folder / "timestamps.txt") as temporary:
        temporary.write_text("".join(f"{f.name} {f.timestamp:.9f}\n" for f in frames), encoding="utf-8")


def save_calibration(folder: Path, calibration: Calibration) -> None:
    """The camera of the undistorted frames."""
    write_json(folder / "calibration.json", asdict(calibration))


def calibration_from_json(value: dict[str, Any]) -> Calibration:
    """Inverse of `asdict(calibration)` after JSON."""
    distortion = tuple(value["distortion"])
    return Calibration(Intrinsics(**value["intrinsics"]), value["origin"], value["focal_sd"], distortion)


def save_sparse_model(path: Path, model: SparseModel) -> None:
    """One npz."""
    save_arrays(path, dict(model.__dict__))


def load_sparse_model(path: Path) -> SparseModel:
    """Inverse of `save_sparse_model`."""
    return SparseModel(**load_arrays(path))


def save_classes(folder: Path, classes: ClassTable) -> None:
    """[{"id", "name", "color"}]."""
    rows = [
        {"id": i, "name": n, "color": list(c)}
        for i, (n, c) in enumerate(zip(classes.names, classes.colors, strict=True))
    ]
    write_json(folder / "classes.json", rows)


def proxy_path(folder: Path, frame_id: int) -> Path:
    """Where a frame's proxy maps lie."""
    return folder / "maps" / f"{frame_id:06d}.npz"


def save_proxy_maps(path: Path, maps: ProxyMaps) -> None:
    """Half-precision inverse depth and 8-bit confidences: about 0.3 MB at 640 x 480.

    Inverse depth in half precision keeps 11 significant bits (0.05 %) at any distance.
    """
    # 65504 is the largest half; unknown depth stays 0.
    inverse = np.divide(1.0, maps.depth, out=np.zeros_like(maps.depth), where=maps.depth > 0)
    save_arrays(
        path,
        {
            "inverse_depth": np.clip(inverse, 0, 65504).astype(np.float16),
            "confidence": np.round(maps.confidence * 255).astype(np.uint8),
            "labels": maps.labels,
            "label_confidence": np.round(maps.label_confidence * 255).astype(np.uint8),
        },
    )


def load_proxy_maps(path: Path) -> ProxyMaps:
    """Inverse of `save_proxy_maps`, up to its rounding."""
    arrays = load_arrays(path)
    inverse = arrays["inverse_depth"].astype(np.float32)
    return ProxyMaps(
        depth=np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0),
        confidence=arrays["confidence"].astype(np.float32) / np.float32(255),
        labels=arrays["labels"],
        label_confidence=arrays["label_confidence"].astype(np.float32) / np.float32(255),
    )


def save_frame_scales(folder: Path, scales: dict[int, float], spreads: dict[int, float]) -> None:
    """[{"frame_id", "scale", "spread"}]: proxy depth over the depth of the backbone's points, and how its own points
    stray from that, relatively."""
    rows = [{"frame_id": i, "scale": round(s, 6), "spread": round(spreads[i], 6)} for i, s in scales.items()]
    write_json(folder / "frame_scales.json", rows)


def save_descriptors(folder: Path, vectors: dict[int, NDArray[np.float32]]) -> None:
    """One npz; nothing where there are none."""
    if vectors:
        ids = np.array(list(vectors), np.int64)
        save_arrays(folder / "descriptors.npz", {"frame_ids": ids, "vectors": np.stack(list(vectors.values()))})


def save_mirror_pairs(folder: Path, pairs_of: dict[int, MirrorPairs]) -> None:
    """One npz of all frames that have any; nothing where none has."""
    kept = {i: p for i, p in pairs_of.items() if len(p)}
    if not kept:
        return
    arrays = {n: np.concatenate([getattr(p, n) for p in kept.values()]) for n in _PAIR_ARRAYS}
    of_frame = np.repeat(np.array(list(kept), np.int64), [len(p) for p in kept.values()])
    save_arrays(folder / "symmetry.npz", {"of_frame": of_frame, **arrays})


def load_mirror_pairs(path: Path) -> dict[int, MirrorPairs]:
    """Inverse of `save_mirror_pairs`."""
    arrays = load_arrays(path)
    of_frame = arrays["of_frame"]
    return {int(i): MirrorPairs(*(arrays[n][of_frame == i] for n in _PAIR_ARRAYS)) for i in np.unique(of_frame)}


_PAIR_ARRAYS = ("pairs", "confidence", "gain", "offset")


def save_trajectory(folder: Path, trajectory: Trajectory) -> None:
    """One npz."""
    arrays = dict(trajectory.__dict__)
    arrays["lost_reasons"] = np.array(trajectory.lost_reasons, dtype=np.str_)
    save_arrays(folder / "trajectory.npz", arrays)


def save_map(folder: Path, gaussian_map: GaussianMap) -> None:
    """One safetensors file."""
    save_tensors(folder / "map.safetensors", {k: v.detach().cpu().contiguous() for k, v in vars(gaussian_map).items()})


def save_exposure(
    folder: Path, frame_ids: NDArray[np.int64], log_gains: NDArray[np.float32], offsets: NDArray[np.float32]
) -> None:
    """picture = colours of the map * exp(log gain) + offset, a keyframe and channel."""
    save_arrays(folder / "exposure.npz", {"frame_ids": frame_ids, "log_gains": log_gains, "offsets": offsets})


def save_loops(folder: Path, loops: list[LoopEdge]) -> None:
    """The verified loops."""
    rows = [{**vars(e), "frame2_from_frame1": e.frame2_from_frame1.tolist()} for e in loops]
    write_json(folder / "loops.json", rows)


def resize_maps(maps: ProxyMaps, width: int, height: int) -> ProxyMaps:
    """Proxy maps at another resolution. Nearest neighbour: depth must not be averaged across an edge."""

    def nearest(array: NDArray) -> NDArray:
        return cv2.resize(array, (width, height), interpolation=cv2.INTER_NEAREST)

    return ProxyMaps(*(nearest(getattr(maps, n)) for n in ("depth", "confidence", "labels", "label_confidence")))
