"""README.txt of an export: what each file is for, what the coordinates mean, and whose networks it rests on."""

import re
import textwrap
from collections.abc import Iterable, Mapping
from typing import Any

from ...formats.atomic import write_text
from ..networks.registry import ModelStore
from ..run.target import Target
from ..scene.world import World
from ..types import Metres
from .kinds import EXPORTS, NOTES, PIECES, README, ExportedFile
from .scene import ExportScene

WIDTH = 100
"""Characters a line, so that it fits a terminal, an editor and the report."""
_COLUMN = 27
_MORE = "More kinds of files: msgs-slam export --help"

_UPRIGHT = """\
Axes: z is up, from the {source}; {height}.
{heading}. So have trajectory.txt and mesh.ply. Trainers and viewers of splats take y for down:
sparse/0, transforms.json and point_cloud*.ply and .sog are turned to x right, y down, z forward, (x, y, z) to
(x, -z, y). In GLB, SPZ and USD files y is up, as these formats define it.
"""
_OWN_HEADING = """\
x and y count from the middle of the camera's path, and y points where the first camera looked"""
_FIRST = """\
Axes: the run's own, about those of the first posed camera: x right, y down, z forward, since the gravity direction is
unknown or was not asked for (export.axes).
"""
_FREE = "The unit of lengths is free: one camera cannot measure metres. Metric depth or --scale-ref makes them metres."


def write_readme(scene: ExportScene, target: Target, files: Iterable[str]) -> None:
    """Write README.txt about those of the files, by their relative paths."""
    outcome = scene.outcome
    text = readme(scene.world, outcome.metres, outcome.metric, files)
    used = licences([record.figures for record in outcome.records.values()], outcome.metres)
    write_text(target.path(README), text + used)


def readme(world: World, metres: Metres | None, metric: bool, files: Iterable[str] = ()) -> str:
    """Return the text of README.txt for files in that world, by their relative paths."""
    if world.axes == "up":
        height = "the floor is at z = 0" if world.has_floor else "no floor was found, so z counts from that path too"
        heading = "x is east and y north (GPS, see world.json)" if world.earth else _OWN_HEADING
        axes = _UPRIGHT.format(source=world.source, height=height, heading=heading)
    else:
        axes = _FIRST
    tops = {PIECES if name.startswith(PIECES) else name.partition("/")[0] for name in files}
    known = [*(file for export in EXPORTS for file in export.files), *NOTES]
    entries = [_entry(file) for file in known if not tops.isdisjoint(file.tops)]
    lines = [" ".join(axes.split()), *lengths(metres, metric).splitlines()]
    about = [textwrap.fill(line, WIDTH, break_on_hyphens=False) for line in lines]
    return "\n".join(["What is in this folder", "", *entries, "", _MORE, "", *about]) + "\n"


def _entry(file: ExportedFile) -> str:
    """The name, and the text beside it; below it where the name is long."""
    text = ". ".join(filter(None, [file.about, f"Opens in {file.opens}" if file.opens else ""])) + "."
    first = "" if len(file.name) < _COLUMN - 1 else f"{file.name}\n"
    head, indent = " " * _COLUMN if first else file.name.ljust(_COLUMN), " " * _COLUMN
    return first + textwrap.fill(text, WIDTH, initial_indent=head, subsequent_indent=indent, break_on_hyphens=False)


def lengths(metres: Metres | None, metric: bool) -> str:
    """Describe the unit of length in a line or two of plain text."""
    if metres is None:
        return "Lengths are metres." if metric else _FREE
    if metric:
        return f"Lengths are metres: {metres.text}."
    return (
        f"{metres.text[0].upper()}{metres.text[1:]}.\n"
        f"Coordinates are not rescaled: multiply lengths by {metres.per_unit:.3g} to have them in metres."
    )


def licences(figures: Iterable[Mapping[str, Any]], metres: Metres | None) -> str:
    """Name the networks that figures of stages and the metres rest on, with their licences; "" without any."""
    said = " ".join(str(value) for of_stage in figures for value in of_stage.values())
    named = set(re.findall(r"(?:onnx|tflite):([\w.-]+)", said))
    named |= set(re.findall(r"network ([\w.-]+)", metres.text if metres else ""))
    lines = [
        f"  {m.name}: {m.licence}{'' if m.commercial else ' (ask before commercial use)'}"
        for m in ModelStore.open().models
        if m.name in named
    ]
    return "\n".join(["\nNetworks that these results were made with, and their licences:", *lines, ""]) if lines else ""
