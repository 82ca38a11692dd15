"""Small plots as SVG text: no library, no network, sharp at any size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

BLUE, ORANGE, GREY, RED, GREEN = "#2563eb", "#ea580c", "#9ca3af", "#dc2626", "#16a34a"


@dataclass(frozen=True)
class Line:
    """points (N, 2), NaN where the line is interrupted."""

    points: NDArray
    color: str
    name: str
    dashed: bool = False


@dataclass(frozen=True)
class Marks:
    """points (N, 2) drawn as dots."""

    points: NDArray
    color: str
    name: str
    radius: float = 2.5


def plot(
    title: str,
    x_label: str,
    y_label: str,
    lines: Sequence[Line] = (),
    marks: Sequence[Marks] = (),
    equal: bool = False,
    width: int = 560,
    height: int = 320,
) -> str:
    """One SVG. `equal`: the same scale on both axes. What is not finite is left out."""
    drawn: list[Line | Marks] = [*lines, *marks]
    groups = [g.points[np.isfinite(g.points).all(axis=1)] for g in drawn if len(g.points)]
    every = np.concatenate(groups) if groups else np.zeros((0, 2))
    if len(every) == 0:
        every = np.array([[0.0, 0.0], [1.0, 1.0]])
    frame = _Frame.around(every, width, height, equal)
    parts = [
        f'<svg viewBox="0 0 {width} {height}" class="plot" role="img" aria-label="{escape(title)}" '
        'xmlns="http://www.w3.org/2000/svg" font-family="system-ui, sans-serif" font-size="11">',
        f'<text x="{frame.left}" y="16" font-size="13" font-weight="600">{escape(title)}</text>',
        _grid(frame),
        *(_line(frame, line) for line in lines),
        *(_marks(frame, mark) for mark in marks),
        f'<text x="{(frame.left + frame.right) / 2}" y="{height - 4}" text-anchor="middle">{escape(x_label)}</text>',
        f'<text transform="translate(12 {(frame.top + frame.bottom) / 2}) rotate(-90)" text-anchor="middle">'
        f"{escape(y_label)}</text>",
        _legend(frame, [(g.name, g.color) for g in drawn]),
        "</svg>",
    ]
    return "".join(parts)


@dataclass(frozen=True)
class _Frame:
    low: NDArray
    high: NDArray
    left: float
    right: float
    top: float
    bottom: float

    @staticmethod
    def around(points: NDArray, width: int, height: int, equal: bool) -> _Frame:
        low, high = points.min(axis=0), points.max(axis=0)
        span = np.maximum(high - low, 1e-9 + 1e-3 * np.abs(high))
        low, high = low - 0.05 * span, high + 0.05 * span
        left, right, top, bottom = 56.0, width - 12.0, 40.0, height - 34.0
        if equal:
            scale = max((high - low) / (right - left, bottom - top))
            half = scale * np.array([right - left, bottom - top]) / 2
            low, high = (low + high) / 2 - half, (low + high) / 2 + half
        return _Frame(low, high, left, right, top, bottom)

    def place(self, points: NDArray) -> NDArray:
        share = (points - self.low) / (self.high - self.low)
        return np.stack(
            [self.left + share[:, 0] * (self.right - self.left), self.bottom - share[:, 1] * (self.bottom - self.top)],
            axis=1,
        )


def ticks(low: float, high: float, about: int = 6) -> list[float]:
    """Round numbers between low and high."""
    raw = (high - low) / about
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min((m for m in (1, 2, 5, 10) if m * power >= raw), default=10)
    return [float(round(v / step) * step) for v in np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step]


def _grid(frame: _Frame) -> str:
    parts = []
    for x in ticks(frame.low[0], frame.high[0]):
        at = float(frame.place(np.array([[x, frame.low[1]]]))[0, 0])
        parts.append(f'<line x1="{at:.1f}" x2="{at:.1f}" y1="{frame.top}" y2="{frame.bottom}" stroke="#e5e7eb"/>')
        parts.append(f'<text x="{at:.1f}" y="{frame.bottom + 14}" text-anchor="middle" fill="#4b5563">{x:.6g}</text>')
    for y in ticks(frame.low[1], frame.high[1], 5):
        at = float(frame.place(np.array([[frame.low[0], y]]))[0, 1])
        parts.append(f'<line y1="{at:.1f}" y2="{at:.1f}" x1="{frame.left}" x2="{frame.right}" stroke="#e5e7eb"/>')
        parts.append(f'<text x="{frame.left - 5}" y="{at + 4:.1f}" text-anchor="end" fill="#4b5563">{y:.6g}</text>')
    return "".join(parts)


def _line(frame: _Frame, line: Line) -> str:
    finite = np.isfinite(line.points).all(axis=1)
    placed = frame.place(np.where(finite[:, None], line.points, 0))
    path, pen_down = [], False
    for ok, (x, y) in zip(finite, placed, strict=True):
        if ok:
            path.append(f"{'L' if pen_down else 'M'}{x:.1f} {y:.1f}")
        pen_down = bool(ok)
    dash = ' stroke-dasharray="5 4"' if line.dashed else ""
    return f'<path d="{"".join(path)}" fill="none" stroke="{line.color}" stroke-width="1.8"{dash}/>'


def _marks(frame: _Frame, marks: Marks) -> str:
    finite = marks.points[np.isfinite(marks.points).all(axis=1)]
    if len(finite) == 0:
        return ""
    return "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{marks.radius}" fill="{marks.color}"/>' for x, y in frame.place(finite)
    )


def _legend(frame: _Frame, names: Sequence[tuple[str, str]]) -> str:
    parts, x = [], frame.left
    for name, color in names:
        if not name:
            continue
        parts.append(f'<rect x="{x}" y="24" width="12" height="4" fill="{color}"/>')
        parts.append(f'<text x="{x + 16}" y="31" fill="#374151">{escape(name)}</text>')
        x += 30 + 6.2 * len(name)
    return "".join(parts)
