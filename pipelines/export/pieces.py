"""Pieces: each disconnected component of a run becomes a small run inside it, RUN/piece_2 and so on.

A piece has its own frames, world and unit of length. Its first stage takes them out of the run around it, the others
are those of any run, and so is all that reads it.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from ...formats.atomic import copy_file
from ...formats.errors import InputError, RecoverableError
from ..config import Config
from ..outcome import load_outcome
from ..run.ending import discard
from ..run.files import (
    BACKBONE,
    CALIBRATION,
    FEATURES,
    FRAMES,
    LEFT_OUT,
    MATCHED_PAIRS,
    SPARSE,
    TRAJECTORY,
    VOCABULARY,
    save_frames,
)
from ..run.folder import RunFolder, load_records
from ..run.manifest import piece_digest
from ..run.runner import run_stages
from ..run.stages import Stage, StageContext
from ..run.target import Target
from ..scene.world import FIRST
from ..system.progress import WithinStage
from .colmap import write_colmap, write_trajectory
from .scene import ExportScene


def write_pieces(context: StageContext) -> None:
    """Make the pieces, and write piece_2 and so on: each with all the files of an export, or with its poses."""
    for piece in make_pieces(context):
        if "export" in (records := load_records(piece)):
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
    records, made = load_records(run), []
    for name in names:
        piece = run.piece(name)
        piece.root.mkdir(exist_ok=True)
        stages = [Stage("frames", take_frames), *context.stages[1:]]
        try:
            inside = WithinStage(context.progress, name)
            run_stages(stages, piece, context.source, piece_digest(records, name), _settings(context.config), inside)
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
            LEFT_OUT.save(context.folder, mask, frame.name)
    save_frames(context.folder, [replace(frames[old], id=new) for old, new in number.items()])
    CALIBRATION.save(context.folder, around.load(CALIBRATION))
    model = around.load(SPARSE, "tracking", piece=name)
    BACKBONE.save(context.folder, replace(model, frame_ids=np.array([number[i] for i in model.frame_ids.tolist()])))
    for old, new in number.items():
        if (features := around.find(FEATURES, of=old)) is not None:
            FEATURES.save(context.folder, features, of=new)
    tried = {
        (number[i], number[j]): n for (i, j), n in around.load(MATCHED_PAIRS).items() if i in number and j in number
    }
    VOCABULARY.save(context.folder, around.load(VOCABULARY))
    MATCHED_PAIRS.save(context.folder, tried)
    return {"frames": len(posed), "keyframes": len(model.frame_ids), "of_the_run": [posed[0], posed[-1]]}
