"""Pieces of a web page that needs nothing but itself: sections, tables, plots as SVG."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

BLUE, GREY, RED = "#2563eb", "#9ca3af", "#dc2626"

STYLE = """
:root{--ink:#111827;--soft:#6b7280;--line:#e5e7eb;--card:#fff;--back:#f3f4f6;--accent:#2563eb}
*{box-sizing:border-box}
body{margin:0;background:var(--back);color:var(--ink);font:15px/1.5 system-ui,-apple-system,"Segoe UI",sans-serif}
main{max-width:1240px;margin:0 auto;padding:28px 20px 60px}
h1{font-size:26px;margin:0 0 2px;overflow-wrap:anywhere}h2{font-size:18px;margin:0 0 12px}
.sub{color:var(--soft);margin:0 0 18px;overflow-wrap:anywhere}
section{background:var(--card);border:1px solid var(--line);border-radius:12px;padding:18px 20px;margin:16px 0}
.chips{display:flex;flex-wrap:wrap;gap:10px}
.chip{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:8px 14px;min-width:120px}
.chip b{display:block;font-size:20px}.chip span{color:var(--soft);font-size:12px}
.two{display:grid;grid-template-columns:repeat(auto-fill,minmax(440px,1fr));gap:14px}
.plot{width:100%;height:auto;display:block}
table{border-collapse:collapse;width:100%;font-size:14px}
th,td{text-align:left;padding:6px 10px;border-bottom:1px solid var(--line);vertical-align:top;overflow-wrap:break-word}
td:last-child{overflow-wrap:anywhere}
th{color:var(--soft);font-weight:600}
img{max-width:100%;border-radius:6px;display:block}
ul{margin:0;padding-left:20px}li{margin:4px 0}
pre{background:#f9fafb;border:1px solid var(--line);border-radius:8px;padding:12px;overflow:auto;font-size:12.5px}
summary{cursor:pointer;color:var(--accent)}
.advice{border-left:5px solid #f59e0b}.fine{border-left:5px solid #16a34a}
.grid{display:grid;grid-template-columns:repeat(4,1fr);gap:6px}
.grid div{font-size:12px;color:var(--soft)}
code{background:#f3f4f6;padding:1px 5px;border-radius:4px;overflow-wrap:anywhere}
.legend{display:flex;flex-wrap:wrap;gap:4px 16px;margin-top:12px;font-size:13px}
.legend i{display:inline-block;width:13px;height:13px;border-radius:3px;margin-right:6px;vertical-align:-2px}
.legend.scale i{width:220px;max-width:50%;margin:3px 6px}
.legend span{color:var(--soft)}
details{margin-top:10px}pre{white-space:pre-wrap;overflow-wrap:anywhere}
@media (max-width:700px){.grid{grid-template-columns:repeat(2,1fr)}.two{grid-template-columns:1fr}
main{padding:16px 8px 40px}section{padding:12px}
th,td{padding:5px 4px;font-size:13px;min-width:5.6em;overflow-wrap:anywhere}
td:first-child,th:first-child{min-width:7.2em}pre{white-space:pre}}
@media print{@page{margin:14mm}
body{background:#fff;font-size:11px;print-color-adjust:exact;-webkit-print-color-adjust:exact}
main{max-width:none;padding:0}section{border:0;padding:6px 0;margin:8px 0}
.chip{padding:4px 8px;min-width:0}.chip b{font-size:14px}.two{grid-template-columns:1fr 1fr}
h2{break-after:avoid}.chip,tr,img,.plot,.grid div,li{break-inside:avoid}details:not([open]){display:none}}
"""


def page(title: str, body: str) -> str:
    """A whole document. The policy forbids every request to the outside."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\">"
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body><main>{body}</main></body></html>\n"
    )


def section(title: str, *content: str, kind: str = "") -> str:
    """A card with a heading."""
    return f'<section class="{kind}"><h2>{escape(title)}</h2>{"".join(content)}</section>'


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Cells are plain text; a header of empty texts is left out."""
    cells = "".join(f"<th>{escape(h)}</th>" for h in header)
    head = f"<thead><tr>{cells}</tr></thead>" if any(header) else ""
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table>{head}<tbody>{body}</tbody></table>"


def bullets(lines: Iterable[str]) -> str:
    """Items are plain text."""
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def chips(pairs: Iterable[tuple[str, str]]) -> str:
    """(name, value) pairs as a row of little cards."""
    cards = (f'<div class="chip"><b>{escape(value)}</b><span>{escape(name)}</span></div>' for name, value in pairs)
    return f'<div class="chips">{"".join(cards)}</div>'


def legend(entries: Iterable[tuple[str, str, str]]) -> str:
    """(name, CSS colour, text beside it) as a line of swatches."""
    swatches = (
        f'<div><i style="background:{escape(color)}"></i>{escape(name)} <span>{escape(text)}</span></div>'
        for name, color, text in entries
    )
    return f'<div class="legend">{"".join(swatches)}</div>'


def drawing(svg: bytes, description: str) -> str:
    """An SVG file inside the page as a picture, in which nothing of it can act."""
    text = base64.b64encode(svg).decode("ascii")
    return f'<img class="plot" alt="{escape(description)}" src="data:image/svg+xml;base64,{text}">'


def image(picture: NDArray[np.uint8], description: str, quality: int = 85) -> str:
    """An RGB picture (H, W, 3) inside the page, as JPEG."""
    good, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not good:
        raise RuntimeError("OpenCV could not encode a JPEG")
    text = base64.b64encode(data.tobytes()).decode("ascii")
    return f'<img alt="{escape(description)}" src="data:image/jpeg;base64,{text}">'


@dataclass(frozen=True)
class Line:
    """points (N, 2), NaN where the line is interrupted."""

    points: NDArray
    color: str
    name: str
    dashed: bool = False


def plot(
    title: str,
    x_label: str,
    y_label: str,
    lines: Sequence[Line] = (),
    equal: bool = False,
    width: int = 560,
    height: int = 320,
) -> str:
    """One SVG. `equal`: the same scale on both axes. What is not finite is left out."""
    every = np.concatenate([np.zeros((0, 2)), *(g.points[np.isfinite(g.points).all(axis=1)] for g in lines)])
    frame = _Frame.around(every if len(every) else np.eye(2), width, height, equal)
    parts = [
        f'<svg viewBox="0 0 {width} {height}" class="plot" role="img" aria-label="{escape(title)}" '
        'xmlns="http://www.w3.org/2000/svg" font-family="system-ui, sans-serif" font-size="11">',
        f'<text x="{frame.left}" y="16" font-size="13" font-weight="600">{escape(title)}</text>',
        _grid(frame),
        *(_line(frame, line) for line in lines),
        f'<text x="{(frame.left + frame.right) / 2}" y="{height - 4}" text-anchor="middle">{escape(x_label)}</text>',
        f'<text transform="translate(12 {(frame.top + frame.bottom) / 2}) rotate(-90)" text-anchor="middle">'
        f"{escape(y_label)}</text>",
        _legend(frame, [(g.name, g.color) for g in lines]),
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
    for axis, about in ((0, 6), (1, 5)):
        for value in ticks(frame.low[axis], frame.high[axis], about):
            x, y = frame.place(np.where(np.arange(2) == axis, value, frame.low)[None])[0]
            ends = (x, x, frame.top, frame.bottom) if axis == 0 else (frame.left, frame.right, y, y)
            at = (x, frame.bottom + 14, "middle") if axis == 0 else (frame.left - 5, y + 4, "end")
            parts.append('<line x1="{:.1f}" x2="{:.1f}" y1="{:.1f}" y2="{:.1f}" stroke="#e5e7eb"/>'.format(*ends))
            head = '<text x="{:.1f}" y="{:.1f}" text-anchor="{}" fill="#4b5563">'.format(*at)
            parts.append(f"{head}{value:.6g}</text>")
    return "".join(parts)


def _line(frame: _Frame, line: Line) -> str:
    finite = np.isfinite(line.points).all(axis=1)
    placed = frame.place(np.where(finite[:, None], line.points, 0))
    path, pen_down = [], False
    for ok, (x, y) in zip(finite, placed, strict=True):
        if ok:
            path.append(f"L{x:.1f} {y:.1f}" if pen_down else f"M{x:.1f} {y:.1f}h0")  # alone it is a dot
        pen_down = bool(ok)
    dash = ' stroke-dasharray="5 4"' if line.dashed else ""
    return (
        f'<path d="{"".join(path)}" fill="none" stroke="{line.color}" stroke-width="1.8" stroke-linecap="round"{dash}/>'
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
