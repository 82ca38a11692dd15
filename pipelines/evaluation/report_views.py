"""The rendered keyframes of a report, and their figures."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from ..outcome import Outcome, evenly
from ..source.sharpness import at_most_wide
from ..system.progress import Progress
from ..types import VOID
from .facts import Capture
from .html import image, legend, section
from .image_quality import psnr
from .measure import render_outcome
from .pictures import depth_picture, depth_range, labels_on_photo
from .plots import BLUE, GREEN, GREY, ORANGE, RED, Line, Marks, plot
from .write import unit_name

MEASURED_VIEWS = 60
SHOWN_VIEWS = 8
_TILE_WIDTH = 400
_ROWS = 3
"""Of four pictures, seen at once; the others unfold."""


@dataclass(frozen=True)
class RenderedViews:
    """Rendered keyframes: ids (V,), psnr (V,), pixels of each label (256,), and a sheet as HTML."""

    ids: list[int]
    psnr: list[float]
    class_pixels: NDArray[np.int64]
    sheet: str


def render_views(outcome: Outcome, progress: Progress) -> RenderedViews:
    """Up to `MEASURED_VIEWS` keyframes, evenly spread; a few of them on the sheet."""
    t = outcome.trajectory
    keyframes = evenly(t.frame_ids[t.is_keyframe].tolist(), MEASURED_VIEWS)
    shown = set(evenly(keyframes, SHOWN_VIEWS))
    values: list[float] = []
    tiles: list[str] = []
    reach = _reach(outcome, sorted(shown))
    counts = np.zeros(256, np.int64)
    for frame_id in progress.track(keyframes, "rendering", len(keyframes)):
        row = outcome.frame_row(frame_id)
        frame, photo = outcome.frames[row], outcome.run.image(outcome.frames[row])
        view = render_outcome(outcome, t.cam_from_world[row])
        picture = view.exposed(outcome.exposure, frame.timestamp)
        values.append(psnr(picture, photo))
        counts += np.bincount(view.labels.ravel(), minlength=256)
        if frame_id in shown:
            depth = depth_picture(view.depth, *reach)
            labels = labels_on_photo(photo, view.labels, outcome.classes.colors)
            pairs = ((photo, "image"), (picture, "map"), (depth, "depth"), (labels, "classes"))
            tiles += [_tile(p, f"{what}, {frame.timestamp:.2f} s") for p, what in pairs]
    first, rest = "".join(tiles[: 4 * _ROWS]), "".join(tiles[4 * _ROWS :])
    more = f'<details><summary>More views</summary><div class="grid">{rest}</div></details>' if rest else ""
    scale = _depth_scale(*reach, unit_name(outcome))
    return RenderedViews(keyframes, values, counts, f'<div class="grid">{first}</div>{more}{scale}')


def _depth_scale(nearest: float, farthest: float, unit: str) -> str:
    """The colours of depth, with the depths of both ends and of the middle."""
    depths = 1 / np.linspace(1 / nearest, 1 / farthest, 9)
    colors = ",".join("rgb({},{},{})".format(*c) for c in depth_picture(depths[None], nearest, farthest)[0].tolist())
    low, middle, high = (f"{depths[k]:.2g}" for k in (0, 4, 8))
    bar = f'<i style="background:linear-gradient(to right,{colors})"></i>'
    told = f"depth, {escape(unit)}: {low} {bar} {high} <span>({middle} in the middle)</span>"
    return f'<div class="legend scale">{told}</div>'


def _reach(outcome: Outcome, ids: list[int]) -> tuple[float, float]:
    """Nearest and farthest of most pixels of a few of the views: one range for all, so that colours compare."""
    rows = [outcome.frame_row(frame_id) for frame_id in ids[:: max(1, len(ids) // 3)]]
    ranges = [depth_range(render_outcome(outcome, outcome.trajectory.cam_from_world[row]).depth) for row in rows]
    return (min(r[0] for r in ranges), max(r[1] for r in ranges)) if ranges else (1.0, 2.0)


def _tile(picture: NDArray[np.uint8], caption: str) -> str:
    return f"<div>{image(at_most_wide(picture, _TILE_WIDTH), caption)}{escape(caption)}</div>"


def quality_section(outcome: Outcome, capture: Capture, views: RenderedViews | None) -> str:
    """Plots over the frames."""
    ids = np.array([f.id for f in outcome.frames], np.float64)
    series: list[tuple[str, str, NDArray, NDArray, str]] = []
    if views is not None:
        series.append(("PSNR of keyframes", "dB", np.array(views.ids), np.array(views.psnr), BLUE))
    series.append(("Sharpness, 1 = usual", "", ids, capture.sharpness, ORANGE))
    series.append(("Mean brightness", "0..255", ids, capture.brightness, GREY))
    order = np.argsort(capture.point_ids)
    series.append(("Points seen", "", capture.point_ids[order], capture.points[order], GREEN))
    series.append(("Mean reliability U of the proxy depth", "0..1", capture.proxy_ids, capture.reliability, RED))
    return section(
        "Quality along the way",
        '<div class="two">',
        *(_over_frames(name, unit, x, y, color) for name, unit, x, y, color in series if len(x)),
        "</div>",
    )


def _over_frames(name: str, unit: str, ids: NDArray, values: NDArray, color: str) -> str:
    points = np.stack([ids.astype(np.float64), np.asarray(values, np.float64)], axis=1)
    marks = [Marks(points, color, "", 1.8)] if len(points) < 150 else []
    return plot(name, "frame", unit, [Line(points, color, "")], marks, height=240)


def class_legend(outcome: Outcome, views: RenderedViews) -> str:
    """Colour, name and share of each class in the rendered keyframes, largest first."""
    shares = views.class_pixels / max(int(views.class_pixels.sum()), 1)
    rows = [
        (float(shares[i]), name, "rgb({},{},{})".format(*color))
        for i, (name, color) in enumerate(zip(outcome.classes.names, outcome.classes.colors, strict=True))
        if shares[i] > 0
    ]
    rows = [*sorted(rows, key=lambda row: -row[0]), (float(shares[VOID]), "unknown", "rgb(40,40,40)")]
    return legend([(name, color, f"{share:.1%}") for share, name, color in rows])
