"""The rendered keyframes of a report, and what they tell."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.evaluation.facts import Capture
from msgs_slam.pipelines.evaluation.html import image, section
from msgs_slam.pipelines.evaluation.image_quality import psnr
from msgs_slam.pipelines.evaluation.measure import render_outcome
from msgs_slam.pipelines.evaluation.pictures import depth_picture, depth_range, labels_on_photo
from msgs_slam.pipelines.evaluation.plots import BLUE, GREEN, GREY, ORANGE, RED, Line, Marks, bars, plot
from msgs_slam.pipelines.outcome import Outcome, evenly
from msgs_slam.pipelines.system.progress import Progress
from msgs_slam.pipelines.types import VOID

MEASURED_VIEWS = 60
SHOWN_VIEWS = 8


@dataclass(frozen=True)
class RenderedViews:
    """What rendering the keyframes gave: ids (V,), psnr (V,), pixels of each label (256,), and a sheet as HTML."""

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
    counts = np.zeros(256, np.int64)
    for frame_id in progress.track(keyframes, "rendering", len(keyframes)):
        row = outcome.frame_row(frame_id)
        frame, photo = outcome.frames[row], outcome.run.image(outcome.frames[row])
        view = render_outcome(outcome, t.cam_from_world[row])
        picture = view.exposed(outcome.exposure, frame.timestamp)
        values.append(psnr(picture, photo))
        counts += np.bincount(view.labels.ravel(), minlength=256)
        if frame_id in shown:
            depth = depth_picture(view.depth, *depth_range(view.depth))
            labels = labels_on_photo(photo, view.labels, outcome.classes.colors)
            pairs = ((photo, "frame"), (picture, "map"), (depth, "depth"), (labels, "classes"))
            tiles += [_tile(p, f"{what}, {frame.timestamp:.2f} s") for p, what in pairs]
    return RenderedViews(keyframes, values, counts, f'<div class="grid">{"".join(tiles)}</div>')


def _tile(picture: NDArray[np.uint8], caption: str) -> str:
    width = 400
    if picture.shape[1] > width:
        size = (width, round(width * picture.shape[0] / picture.shape[1]))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    return f"<div>{image(picture, caption)}{escape(caption)}</div>"


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


def class_section(outcome: Outcome, views: RenderedViews) -> str:
    """Shares of the classes in the rendered keyframes, largest first."""
    shares = views.class_pixels / max(int(views.class_pixels.sum()), 1)
    rows = [
        (name, float(shares[i]), f"{shares[i]:.1%}", "rgb({},{},{})".format(*color))
        for i, (name, color) in enumerate(zip(outcome.classes.names, outcome.classes.colors, strict=True))
        if shares[i] > 0
    ]
    rows.sort(key=lambda row: -row[1])
    rows.append(("unknown", float(shares[VOID]), f"{shares[VOID]:.1%}", "#d1d5db"))
    return section("Classes in the rendered keyframes", bars("share of the pixels", rows, width=760))
