"""Stage 6, the files for other programs: of a run (`run`), and of a finished one on request (`export_run`);
with README.txt: what each file is for, what the coordinates mean, and whose networks it rests on.

Each disconnected component of a run becomes a small run inside it, RUN/piece_2 and so on, with frames, world and unit
of length of its own. Its first stage takes them out of the run around it, the others are those of any run.
"""

import hashlib
import re
import tempfile
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...formats.atomic import copy_file, write_text
from ...formats.errors import InputError, RecoverableError
from ..config import STAGES, Config, ExportConfig
from ..networks.registry import ModelStore
from ..run.ending import discard
from ..run.files import (
    BACKBONE,
    CALIBRATION,
    CLASSES,
    FEATURES,
    FRAMES,
    LEFT_OUT,
    MATCHED_PAIRS,
    MESH,
    METRES,
    SPARSE,
    SUBMAPS,
    TRAJECTORY,
    VOCABULARY,
    save_frames,
)
from ..run.folder import RunFolder
from ..run.manifest import piece_digest
from ..run.outcome import load_outcome
from ..run.runner import run_stages
from ..run.stages import Stage, StageContext
from ..run.target import Target, read_list
from ..scene.world import FIRST, WORLD, in_world, world_figures
from ..source.recording import is_of_source
from ..system.machine import release_free_memory
from ..system.progress import Progress, SilentProgress, WithinStage
from ..types import Metres
from .colmap import write_colmap, write_trajectory
from .inventory import read_selection
from .kinds import EXPORTS, IMAGES, NOTES, PIECES, README, WORLD_NOTE, Export, ExportedFile, export_of, names_of
from .mesh import mesh_figures
from .scene import (
    ExportScene,
    estimate_metres,
    find_world,
    finished_scene,
    lengths,
    with_things,
    write_things,
    written_things,
)

EXPORTS_FOLDER = "exports"
"""The folder in a run for what is exported on request, a folder a kind; no stage touches it."""
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


def run(context: StageContext) -> dict[str, Any]:
    """Write all files of a run whose map is done, and return the figures of the report; a mesh that an interrupted
    attempt has finished is kept."""
    found = load_outcome(context.run, context.device)
    found.require_map()
    world, reasons = find_world(found, context.config.export)
    for reason in reasons:
        context.warn(reason)
    metres = estimate_metres(context, found, world)
    found = in_world(
        replace(found, metres=metres, gaussian_map=None), world
    )  # the mesh's tasks load the map themselves
    release_free_memory()
    write_pieces(context)
    target, kinds = Target(context.folder), stage_exports(context.run)
    scene = ExportScene(found, world, context)
    for export in (export for export in kinds if export.kind == "mesh"):
        export.writer()(scene, target)
    release_free_memory()
    own_map = load_outcome(context.run, context.device).require_map().moved(world.exported_from_run)
    scene = replace(scene, outcome=replace(found, gaussian_map=own_map), things=written_things(target, world))
    for export in (export for export in kinds if export.kind != "mesh"):
        export.writer()(scene, target)
    write_notes(scene, target, metres)
    write_things(scene, target, scene.things.counted(scene.gaussian_things))
    write_readme(scene, target, files_in(target.folder))
    figures = {"images": int(found.trajectory.is_posed.sum()), "gaussians": len(own_map)}
    figures["things"] = len(scene.things.table)
    mesh = mesh_figures(target.folder / "mesh.ply")
    return {**figures, **mesh, **world_figures(world), **metres_figures(metres)}


def stage_exports(run: RunFolder) -> list[Export]:
    """Return the kinds that the stage writes."""
    has_submaps = bool(run.load(SUBMAPS))
    return [export for export in EXPORTS if export.when == "always" or (has_submaps and export.when == "in submaps")]


def metres_figures(metres: Metres | None) -> dict[str, Any]:
    """Report how long the unit is, and where that comes from."""
    if metres is None:
        return {"metres_per_unit": None}
    return {
        "metres_per_unit": round(metres.per_unit, 4),
        "metres_relative_sd": round(metres.relative_sd, 4),
        "metres_are": "estimated" if metres.is_guess else "given",
        "metres_from": ", ".join([*metres.sources, *["if the scene is a room"] * metres.only_in_room]),
        "metres_disagreement": round(metres.disagreement, 2),
    }


def write_notes(scene: ExportScene, target: Target, metres: Metres | None) -> None:
    """Write the class table, the world, and how many metres a unit of the run's own world is."""
    CLASSES.save(target.path("classes.json").parent, scene.outcome.classes)
    METRES.save(target.path("scale.json").parent, metres)
    write_world(scene, target)


def write_world(scene: ExportScene, target: Target) -> None:
    """Write world.json: what the coordinates of the other files mean."""
    unit = "metre" if scene.outcome.metric or scene.world.earth else "free"
    WORLD.save(target.path("world.json").parent, replace(scene.world, unit=unit))


def files_in(folder: Path) -> list[str]:
    """Return the relative paths, with slashes, of the files below a folder."""
    return [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*")) if path.is_file()]


def export_folder(run: RunFolder, kind: str | None) -> Path:
    """Return the folder of the run for what is exported on request."""
    return run.path(EXPORTS_FOLDER, export_of(kind).kind if kind else "all")


def export_run(
    run: RunFolder,
    folder: Path | None = None,
    only: str | None = None,
    progress: Progress | None = None,
    settings: ExportConfig | None = None,
    overwrite: bool = False,
    only_things: str = "",
    without: str = "",
) -> list[Path]:
    """Write one of the `EXPORTS`, or with None all that the stage writes, of a run into a folder; returns what was
    written.

    folder: None for `export_folder`; settings: None for the run's own; only_things, without: names of things or classes
    with commas between them, for the kinds that hold things. What is written takes the place of an earlier
    export; of other files only where they may be overwritten (see `Target`). Nothing changes before all of it is made.
    Raises InputError for a run without a map, or without a mesh for what is made from it, and for a folder that holds
    such files of somebody else, or belongs to the run.
    """
    folder = export_folder(run, only) if folder is None else folder
    exports = [export_of(only)] if only else stage_exports(run)
    selection = read_selection(run, only_things, without, run.load(CLASSES).names)
    if selection is not None:
        exports = [export for export in exports if export.holds_things]
        if not exports:
            raise InputError(f"{only} holds no things: leave out --only-things and --without, or choose another kind")
    names = names_of(exports, [WORLD_NOTE] if only else NOTES)
    _require_free(run, folder, names)
    if any(export.needs == "mesh" for export in exports) and not run.has(STAGES[-1], MESH):
        raise InputError(
            f"{run.root} has no mesh yet, and {only} is made from it: finish the run with msgs-slam resume"
        )
    outcome = load_outcome(run)
    config = replace(outcome.config, export=settings or outcome.config.export)
    scene = finished_scene(outcome, StageContext(run, Path(), config, Path(), progress or SilentProgress()))
    if any(export.holds_things for export in exports):
        scene = with_things(scene, selection)
    with Target(folder, overwrite, _origin(scene)).replacing(names.__contains__) as staged:
        with tempfile.TemporaryDirectory(dir=staged.folder) as scratch:
            scene = replace(scene, context=replace(scene.context, folder=Path(scratch)))
            for export in exports:
                export.writer()(scene, staged)
        if only or selection is not None:
            write_world(scene, staged)
        else:
            write_notes(scene, staged, scene.outcome.metres)
        stay = [name for name in read_list(folder) if name.partition("/")[0] not in names]
        write_readme(scene, staged, [*stay, *files_in(staged.folder)])
    return [folder / name for name in staged.written if (folder / name).exists()]


def _require_free(run: RunFolder, folder: Path, names: set[str]) -> None:
    """Raise InputError for a folder of the run's own, or of its source."""
    if IMAGES in names and is_of_source(folder / IMAGES, run):
        raise InputError(f"{folder / IMAGES} is the source of {run.root}: name another folder with --to")
    around = run.place.parent if run.is_piece else run.place
    inside = folder.resolve()
    if inside.is_relative_to(around.resolve()) and EXPORTS_FOLDER not in inside.relative_to(around.resolve()).parts:
        raise InputError(
            f"{folder} belongs to the run, whose stages write there: leave --to out, for "
            f"{run.path(EXPORTS_FOLDER)}, or name a folder outside of the run"
        )


def _origin(scene: ExportScene) -> str:
    """Identity of the map and of the world that the files show."""
    outcome, move = scene.outcome, scene.world.exported_from_run
    of_run = [outcome.records[stage].content for stage in (outcome.pose_stage, outcome.map_stage)]
    numbers = [move.scale, *move.rotation.ravel().tolist(), *move.translation.tolist()]
    return hashlib.sha256(" ".join([*of_run, *map(repr, numbers)]).encode()).hexdigest()


def write_readme(scene: ExportScene, target: Target, files: Iterable[str]) -> None:
    """Write README.txt about those of the files, by their relative paths."""
    outcome, world = scene.outcome, scene.world
    if world.axes == "up":
        height = "the floor is at z = 0" if world.has_floor else "no floor was found, so z counts from that path too"
        heading = "x is east and y north (GPS, see world.json)" if world.earth else _OWN_HEADING
        axes = _UPRIGHT.format(source=world.source, height=height, heading=heading)
    else:
        axes = _FIRST
    tops = {PIECES if name.startswith(PIECES) else name.partition("/")[0] for name in files}
    known = [*(file for export in EXPORTS for file in export.files), *NOTES]
    entries = [_entry(file) for file in known if file.tops[0] in tops]
    lines = [" ".join(axes.split()), *lengths(outcome.metres, outcome.metric).splitlines()]
    about = [textwrap.fill(line, WIDTH, break_on_hyphens=False) for line in lines]
    used = licences([record.figures for record in outcome.records.values()], outcome.metres)
    text = "\n".join(["What is in this folder", "", *entries, "", _MORE, "", *about])
    write_text(target.path(README), f"{text}\n{used}")


def _entry(file: ExportedFile) -> str:
    """The name, and the text beside it; below it where the name is long."""
    text = ". ".join(filter(None, [file.about, f"Opens in {file.opens}" if file.opens else ""])) + "."
    first = "" if len(file.name) < _COLUMN - 1 else f"{file.name}\n"
    head, indent = " " * _COLUMN if first else file.name.ljust(_COLUMN), " " * _COLUMN
    return first + textwrap.fill(text, WIDTH, initial_indent=head, subsequent_indent=indent, break_on_hyphens=False)


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


def write_pieces(context: StageContext) -> None:
    """Make the pieces, and write piece_2 and so on: each with all the files of an export, or with its poses."""
    for piece in make_pieces(context):
        if "export" in (records := piece.records):
            for name in records["export"].files:
                copy_file(piece.file("export", name), context.folder / piece.root.name / name)
        elif "tracking" in records:
            scene = ExportScene(load_outcome(piece, context.device), FIRST, context)
            target = Target(context.folder / piece.root.name)
            write_colmap(scene, target)
            write_trajectory(scene, target)


def make_pieces(context: StageContext) -> list[RunFolder]:
    """Bring the pieces that tracking has found up to date, largest first, and remove those it no longer finds; a piece
    of which no map can be made is reported."""
    run, names = context.run, context.run.pieces("tracking")
    for old in run.root.glob("piece_[0-9]*"):
        if old.name not in names and RunFolder(old).manifest_file.exists():
            discard(old)
    records, made = run.records, []
    for name in names:
        piece = run.piece(name)
        piece.root.mkdir(exist_ok=True)
        stages = [Stage("frames", take_frames), *context.stages[1:]]
        try:
            settings, inside = _settings(context.config), WithinStage(context.progress, name)
            work = StageContext(piece, context.source, settings, piece.root, inside, stages=stages)
            tracked = run_stages(work, piece_digest(records, name))["tracking"].figures
            if tracked["posed"] < tracked["frames"]:
                context.warn(f"{name}: {tracked['posed']} of its {tracked['frames']} frames keep their pose alone")
        except RecoverableError:
            raise
        except InputError as error:
            context.warn(f"{name} is posed, and could not be made whole: {error}")
        made.append(piece)
    return made


def _settings(config: Config) -> Config:
    """Those of the run around it; a length that is known in one image says nothing about another world."""
    height = config.proxy.scale_ref.strip().startswith("height")
    return config if height else replace(config, proxy=replace(config.proxy, scale_ref=""))


def take_frames(context: StageContext) -> dict[str, Any]:
    """The stage `frames` of a piece: its frames counted anew, and what the run around it knows of them."""
    around, name = RunFolder(context.run.root.parent), context.run.root.name
    posed = np.flatnonzero(around.load(TRAJECTORY, "tracking", piece=name).is_posed).tolist()
    frames, number = around.load(FRAMES), {old: new for new, old in enumerate(posed)}
    for frame in (frames[i] for i in posed):
        copy_file(around.image_file(frame), context.folder / frame.name)
        if (mask := around.find(LEFT_OUT, of=frame.name)) is not None:
            context.save(LEFT_OUT, mask, frame.name)
    save_frames(context.folder, [replace(frames[old], id=new) for old, new in number.items()])
    context.save(CALIBRATION, around.load(CALIBRATION))
    model = around.load(SPARSE, "tracking", piece=name)
    context.save(BACKBONE, replace(model, frame_ids=np.array([number[i] for i in model.frame_ids.tolist()])))
    for old, new in number.items():
        if (features := around.find(FEATURES, of=old)) is not None:
            context.save(FEATURES, features, of=new)
    tried = {
        (number[i], number[j]): n for (i, j), n in around.load(MATCHED_PAIRS).items() if i in number and j in number
    }
    context.save(VOCABULARY, around.load(VOCABULARY))
    context.save(MATCHED_PAIRS, tried)
    return {"frames": len(posed), "keyframes": len(model.frame_ids), "of_the_run": [posed[0], posed[-1]]}
