"""Files of a run that this room reads beside the maps, and the one it writes in the export."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from msgs_slam.formats.jsonfile import read_json, read_json_object, write_json
from msgs_slam.pipelines.run.folder import SCALE, RunFolder
from msgs_slam.pipelines.run.layouts import dataclass_from_json, reading
from msgs_slam.pipelines.types import Metres, MetresSource

_ALONE = (
    "what each source says without the others, as the mean of its readings: a table may be a desk or a coffee table. "
    "Together they pick the readings that agree, which may lie outside of all of these means. Usual distances are a "
    "weak prior that every guess begins with."
)
_FRAME_SCALES, _TRACKED = "frame_scales.json", "tracking.json"


def load_scale_spreads(run: RunFolder) -> tuple[list[float], float]:
    """Load the relative spread of each frame's proxy depth around its triangulated points, and the relative deviation
    of the scale that tracking fitted to metric depth; ([], 0) where neither is known."""
    sd, spreads = None, []
    if run.has("tracking", _TRACKED):
        sd = read_json_object(run.file("tracking", _TRACKED), None).get("scale_relative_sd")
    if run.has("proxy", _FRAME_SCALES):
        path = run.file("proxy", _FRAME_SCALES)
        rows = read_json(path, None)
        with reading(path, "table of scales"):
            spreads = [float(r["spread"]) for r in rows]
    return spreads, float(sd or 0.0)


def load_metres(run: RunFolder) -> Metres | None:
    """Load the estimate of the world's unit that the export made; None where it made none, or has not run."""
    if not run.has("export", SCALE):
        return None
    if (row := read_json(run.file("export", SCALE))) is None:
        return None
    with reading(run.file("export", SCALE), "scale"):
        alone = tuple(dataclass_from_json(MetresSource, s) for s in row["alone"])
        numbers = {k: float(row[k]) for k in ("per_unit", "relative_sd", "disagreement")}
        sources = tuple(str(s) for s in row["sources"])
        return Metres(**numbers, is_guess=bool(row["is_guess"]), sources=sources, alone=alone)


def save_metres(folder: Path, metres: Metres | None) -> Path:
    """scale.json: the value, its sentence, and what each source says; null where metres are unknown."""
    path = folder / SCALE
    write_json(path, None if metres is None else {"text": metres.text, **asdict(metres), "about_alone": _ALONE})
    return path
