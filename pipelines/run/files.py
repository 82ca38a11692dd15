"""The table of a run's files: a row for each, with its name, the stages that leave it, and what it holds.

What has no row: the images of the frames, what the export writes for other programs (`docs/files.md`; `world.json`,
which is read again, has its row beside its type in `scene/world.py`), and snapshots, which only their stage reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import write_text
from ...formats.reading import is_plain_name
from ..geometry.sparse_model import FrameObservations, SparseModel
from ..system.values import dataclass_from_json
from ..types import (
    VOID,
    Calibration,
    ClassTable,
    Features,
    Frame,
    GivenPoses,
    LoopEdge,
    Metres,
    ProxyMaps,
    Trajectory,
    Vocabulary,
)
from .schema import RunFile, require_increasing, require_indices, require_rigid

if TYPE_CHECKING:
    from ..depth.fields import DepthFields
    from ..render.gaussian_map import GaussianMap

Arrays = Mapping[str, NDArray]
MESH = "mesh.ply"
_LARGEST_HALF = 65504
_BY_SOURCE = (
    "what each source says without the others, as the mean of its readings: a table may be a desk or a coffee table. "
    "Together they pick the readings that agree, which may lie outside of all of these means. Usual distances are a "
    "weak prior that every guess begins with."
)


# frames ---------------------------------------------------------------------------------------------------------


def _frames(rows: Any) -> list[Frame]:
    frames = [dataclass_from_json(Frame, row) for row in rows]
    if [f.id for f in frames] != list(range(len(frames))):
        raise ValueError("the frames are not counted from 0")
    if bad := [f.name for f in frames if not is_plain_name(f.name)]:  # files are copied and removed by these names
        raise ValueError(f"the frame {bad[0][:100]!r} has no plain name")
    return frames


FRAMES: RunFile[list[Frame]] = RunFile(
    "frames.json", ("frames",), "table of frames", _frames, lambda frames: [asdict(f) for f in frames]
)
"""All picked frames in order."""


def save_frames(folder: Path, frames: list[Frame]) -> None:
    """The table of frames, and their timestamps as text for other programs."""
    FRAMES.save(folder, frames)
    write_text(folder / "timestamps.txt", "".join(f"{f.name} {f.timestamp:.9f}\n" for f in frames))


CALIBRATION: RunFile[Calibration] = RunFile(
    "calibration.json", ("frames",), "calibration", lambda value: dataclass_from_json(Calibration, value), asdict
)
"""The camera of the undistorted frames."""

FEATURES: RunFile[Features] = RunFile(
    "correspondence/{:06d}.npz", ("frames",), "file of features", lambda arrays: Features(**arrays), vars,
    {"keypoints": "f F 4", "descriptors": "i F 128"},
)  # fmt: skip
"""Features of a keyframe in undistorted pixels."""

VOCABULARY: RunFile[Vocabulary] = RunFile(
    "correspondence/vocabulary.npz", ("frames",), "vocabulary", lambda arrays: Vocabulary(**arrays), vars,
    {"words": "f W 128", "mean": "f D"},
)  # fmt: skip
"""By which frames are described and compared."""

MATCHED_PAIRS: RunFile[dict[tuple[int, int], int]] = RunFile(
    "correspondence/tried.npz", ("frames",), "table of pairs",
    lambda arrays: {(first, second): matches for first, second, matches in arrays["rows"].tolist()},
    lambda tried: {"rows": np.array([(*pair, count) for pair, count in tried.items()], np.int64).reshape(-1, 3)},
    {"rows": "i P 3"},
)  # fmt: skip
"""(first, second) frame ids of every pair of keyframes that was matched → matches that obey one geometry."""

GIVEN_POSES: RunFile[GivenPoses] = RunFile(
    "given_poses.npz", ("frames",), "file of given poses",
    lambda a: GivenPoses(a["cam_from_world"], bool(a["is_metric"]), str(a["what"])),
    lambda given: {k: np.asarray(v) for k, v in vars(given).items()},
)  # fmt: skip
"""The poses that the user gave for the frames."""

LEFT_OUT: RunFile[NDArray[np.bool_]] = RunFile(
    "masks/{}.png", ("frames", "proxy"), "mask", lambda image: image == 0,
    lambda left_out: np.where(left_out, 0, 255).astype(np.uint8),
)  # fmt: skip
"""(H, W) what of an undistorted frame is no part of the scene, as COLMAP reads masks: black is left out."""


def _sparse_model(arrays: Arrays) -> SparseModel:
    require_increasing("frame_ids", arrays["frame_ids"])
    require_rigid("the poses", arrays["cam_from_world"])
    require_indices("obs_frame", arrays["obs_frame"], len(arrays["frame_ids"]))
    require_indices("obs_point", arrays["obs_point"], len(arrays["points_in_world"]))
    return SparseModel(**arrays)


def _columns(model: SparseModel) -> Arrays:
    return {field.name: getattr(model, field.name) for field in fields(model)}


_SPARSE_LAYOUT = {
    "frame_ids": "i N", "cam_from_world": "f N 4 4", "points_in_world": "f P 3", "colors": "i P 3",
    "obs_frame": "i O", "obs_point": "i O", "obs_xy": "f O 2",
}  # fmt: skip

BACKBONE: RunFile[SparseModel] = RunFile(
    "backbone/model.npz", ("frames",), "sparse model", _sparse_model, _columns, _SPARSE_LAYOUT
)
"""Keyframes and points of structure from motion over the frames; none where it found none."""

SPARSE: RunFile[SparseModel] = RunFile(
    "sparse.npz", ("tracking", "global_ba", "frames"), "sparse model", _sparse_model, _columns, _SPARSE_LAYOUT
)
"""Keyframe poses and points as a stage left them; of frames those of the pieces."""


# proxy ----------------------------------------------------------------------------------------------------------


def _classes(rows: Any) -> ClassTable:
    colors = [(int(r), int(g), int(b)) for r, g, b in (row["color"] for row in rows)]
    if not all(0 <= value <= 255 for color in colors for value in color):
        raise ValueError("a colour is outside 0..255")
    return ClassTable(tuple(str(row["name"]) for row in rows), tuple(colors))


CLASSES: RunFile[ClassTable] = RunFile(
    "classes.json", ("proxy", "export"), "table of classes", _classes,
    lambda classes: [
        {"id": i, "name": n, "color": list(c)}
        for i, (n, c) in enumerate(zip(classes.names, classes.colors, strict=True))
    ],
)  # fmt: skip
"""Names and colours of the labels."""


def _packed_maps(maps: ProxyMaps) -> Arrays:
    """Inverse depth in half precision, 11 significant bits (0.05 %) at any distance, and 8-bit confidences: about
    0.3 MB at 640 x 480. Unknown depth stays 0."""
    inverse = np.divide(1.0, maps.depth, out=np.zeros_like(maps.depth), where=maps.depth > 0)
    return {
        "inverse_depth": np.clip(inverse, 0, _LARGEST_HALF).astype(np.float16),
        "confidence": np.round(maps.confidence * 255).astype(np.uint8),
        "labels": maps.labels,
        "label_confidence": np.round(maps.label_confidence * 255).astype(np.uint8),
    }


def _maps(arrays: Arrays) -> ProxyMaps:
    inverse = arrays["inverse_depth"].astype(np.float32)
    return ProxyMaps(
        depth=np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0),
        confidence=arrays["confidence"].astype(np.float32) / np.float32(255),
        labels=arrays["labels"],
        label_confidence=arrays["label_confidence"].astype(np.float32) / np.float32(255),
    )


PROXY_MAPS: RunFile[ProxyMaps] = RunFile(
    "maps/{:06d}.npz", ("proxy",), "file of proxy maps", _maps, _packed_maps,
    {"inverse_depth": "f H W", "confidence": "i H W", "labels": "i H W", "label_confidence": "i H W"},
)  # fmt: skip
"""Proxy maps of a frame, read back up to the rounding of the file."""

FRAME_SCALES: RunFile[list[dict[str, float]]] = RunFile(
    "frame_scales.json", ("proxy",), "table of scales",
    lambda rows: [
        {"frame_id": int(r["frame_id"]), "scale": float(r["scale"]), "spread": float(r["spread"])} for r in rows
    ],
)  # fmt: skip
"""[{"frame_id", "scale", "spread"}]: proxy depth over the depth of the backbone's points, and how its own points stray
from that, relatively."""

DESCRIPTORS: RunFile[dict[int, NDArray[np.float32]]] = RunFile(
    "descriptors.npz", ("proxy",), "file of descriptors",
    lambda arrays: dict(zip(arrays["frame_ids"].tolist(), arrays["vectors"], strict=True)),
    lambda of: {"frame_ids": np.array(list(of), np.int64), "vectors": np.stack(list(of.values()))},
    {"frame_ids": "i N", "vectors": "f N F"},
)  # fmt: skip
"""Frame id → (F,) global descriptor of a network, a unit vector; none where no network gave one."""


# tracking, mapping, global_ba -----------------------------------------------------------------------------------


def _trajectory(arrays: Arrays) -> Trajectory:
    require_increasing("frame_ids", arrays["frame_ids"])
    require_rigid("the poses", arrays["cam_from_world"])
    reasons = [str(r) for r in arrays["lost_reasons"]]
    known = {k: a for k, a in arrays.items() if k not in ("lost_reasons", "by_rotation")}
    for row in np.flatnonzero(arrays.get("by_rotation", ())):  # a rotation without a place is no pose
        reasons[row], known["cam_from_world"][row] = "only its rotation is known", np.eye(4)
    return Trajectory(**known, lost_reasons=tuple(reasons))


TRAJECTORY: RunFile[Trajectory] = RunFile(
    "trajectory.npz", ("tracking", "mapping", "global_ba"), "trajectory", _trajectory,
    lambda trajectory: {**vars(trajectory), "lost_reasons": np.array(trajectory.lost_reasons, dtype=np.str_)},
    {
        "frame_ids": "i N", "timestamps": "f N", "cam_from_world": "f N 4 4", "is_keyframe": "b N",
        "lost_reasons": "u N", "by_rotation?": "b N",
    },
)  # fmt: skip
"""The poses as a stage left them."""


def _frame_observations(arrays: Arrays) -> FrameObservations:
    frame_id, point = (arrays[name].astype(np.int64) for name in ("frame_id", "obs_point"))
    return FrameObservations(frame_id, point, arrays["obs_xy"])


FRAME_OBSERVATIONS: RunFile[FrameObservations] = RunFile(
    "frame_observations.npz", ("tracking",), "table of observations", _frame_observations,
    lambda seen: {
        "frame_id": seen.frame_id.astype(np.uint32), "obs_point": seen.obs_point.astype(np.uint32),
        "obs_xy": seen.obs_xy.astype(np.float32),
    },
    {"frame_id": "i O", "obs_point": "i O", "obs_xy": "f O 2"},
)  # fmt: skip
"""Where frames that are no keyframes see the points of the stage's sparse model."""

EVERY_FRAME: RunFile[Trajectory] = replace(TRAJECTORY, name="every_frame.npz", stages=("global_ba",))
"""The poses of all images of the source, which frame_ids count; none where all of them were picked."""


def _depth_fields(arrays: Arrays) -> DepthFields:
    from ..depth.fields import DepthFields  # imports scipy

    require_increasing("frame_ids", arrays["frame_ids"])
    return DepthFields(dict(zip(arrays["frame_ids"].tolist(), arrays["log_scales"], strict=True)))


def _log_scales(fields: DepthFields) -> Arrays:
    from ..depth.fields import FINE

    of = fields.of_frame
    nodes = np.array(list(of.values())).reshape(-1, FINE.rows, FINE.columns)
    return {"frame_ids": np.array(list(of), np.int64), "log_scales": nodes}


DEPTH_FIELDS: RunFile[DepthFields] = RunFile(
    "depth_fields.npz", ("tracking", "global_ba"), "file of depth fields", _depth_fields,
    _log_scales, {"frame_ids": "i N", "log_scales": "f N R C"},
)  # fmt: skip
"""The fields that bring proxy depths into the world of a stage."""

EXPOSURE: RunFile[dict[str, Any]] = RunFile(
    "exposure.npz", ("mapping", "global_ba"), "table of exposures", dict, dict,
    {"frame_ids": "i N", "log_gains": "f N 3", "offsets": "f N 3"},
)  # fmt: skip
"""Of each mapped keyframe and channel: image = colours of the map * exp(log gain) + offset."""


def _map(tensors: Mapping[str, Any]) -> GaussianMap:
    from ..render.gaussian_map import GaussianMap  # imports torch, and few who read a run need it

    if not all(bool(t.isfinite().all()) for t in tensors.values()):
        raise ValueError("it holds numbers that are not finite")
    return GaussianMap(**tensors)


MAP: RunFile[GaussianMap] = RunFile("map.safetensors", ("mapping", "global_ba"), "Gaussian map", _map, vars)
"""The Gaussian map as a stage left it, on the host."""


def _loops(rows: Any) -> list[LoopEdge]:
    edges = [dataclass_from_json(LoopEdge, row) for row in rows]
    for edge in edges:
        require_rigid("a loop", edge.frame2_from_frame1)
    return edges


LOOPS: RunFile[list[LoopEdge]] = RunFile(
    "loops.json", ("tracking", "global_ba"), "table of loops", _loops,
    lambda loops: [{**vars(e), "frame2_from_frame1": e.frame2_from_frame1.tolist()} for e in loops],
)  # fmt: skip
"""The verified loops of the global adjustment."""


# figures, for other programs too --------------------------------------------------------------------------------


def _table(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"it holds a {type(value).__name__}, expected an object in braces")
    return value


def _class_ids(value: Any) -> tuple[int, ...]:
    ids = tuple(int(i) for i in _table(value)["class_ids"])
    require_indices("class_ids", np.array(ids, np.int64), VOID)
    return ids


def _submaps(value: Any) -> list[dict[str, NDArray[np.int64]]]:
    rows = _table(value).get("submaps", [])
    return [{k: np.array(row[k], np.int64).reshape(-1) for k in ("own", "border", "beside")} for row in rows]


FIGURES: dict[str, RunFile[dict[str, Any]]] = {
    stage: RunFile(f"{stage}.json", (stage,), "table of figures", _table)
    for stage in ("proxy", "tracking", "mapping", "global_ba")
}
"""By stage: the figures of its result; proxy's say {"depth": provider, "semantics": provider, "metric": bool, ...}."""

CLASS_IDS: RunFile[tuple[int, ...]] = RunFile("mapping.json", ("mapping",), "table of class channels", _class_ids)
"""Of mapping's figures the label of each class channel of the map."""

SUBMAPS: RunFile[list[dict[str, NDArray[np.int64]]]] = RunFile(
    "mapping.json", ("mapping",), "table of submaps", _submaps
)
"""Of mapping's figures each submap's frame ids "own" and "border" and its neighbours "beside"; [] for an undivided
map."""


# export ---------------------------------------------------------------------------------------------------------


_DERIVED_KEYS = ("text", "about_by_source")
"""Keys for people: what they say follows from the others."""

METRES: RunFile[Metres | None] = RunFile(
    "scale.json", ("export",), "scale",
    lambda row: row if row is None else dataclass_from_json(Metres, {k: row[k] for k in row if k not in _DERIVED_KEYS}),
    lambda metres: None if metres is None else {"text": metres.text, **asdict(metres), "about_by_source": _BY_SOURCE},
)  # fmt: skip
"""How long the world's unit is: the value, its sentence, and what each source says; null where metres are unknown."""
