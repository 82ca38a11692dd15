"""Still parts of the images of a recording, while the rest moves: found once, kept in the snapshot, and said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from ...formats.errors import InputError
from ...formats.textfile import read_json, write_json
from ..geometry.camera import Rig
from ..masks.still import SAMPLED, find_still
from ..run.stages import StageContext
from ..sfm.two_views import HOW_TO_FILM
from ..types import Frame
from .masks import FrameMasks

_MOST = 0.65
"""Share of the image beyond which a camera that stands before something that moves is as likely as one that moves."""


@dataclass(frozen=True)
class StillShare:
    """Shares of the image: what stands still and is left out, and over what a reflection does, which cannot be."""

    left_out: float = 0.0
    veil: float = 0.0

    @property
    def warnings(self) -> list[str]:
        """Say what was found, and what to do."""
        said = []
        if self.left_out:
            said.append(
                f"{_percent(self.left_out)} of the image stands still while the rest moves (a bonnet, a display, a "
                "frame around the view?): it is left out, like what --masks leaves out. To take it for scene: "
                "--set frames.still=keep"
            )
        if self.veil:
            said.append(
                f"something translucent, such as a reflection, stands still over {_percent(self.veil)} of the image "
                "while what is behind it moves: poses and focal length may be wrong. Leave the worst of it out with "
                "--masks, or film again without a pane, or with the lens close to it"
            )
        return said

    @property
    def note(self) -> str:
        """Sentence for the end of another message whose cause it may be; "" where nothing was found."""
        noted = []
        if self.left_out:
            noted.append(f"{_percent(self.left_out)} of the image stands still while the rest moves and is left out")
        if self.veil:
            noted.append(f"a reflection or the like stands still over {_percent(self.veil)} of the image")
        return f". Note that {' and '.join(noted)}" if noted else ""

    @property
    def figures(self) -> dict[str, float]:
        """Figures of the stage."""
        return {f"still_{name}": round(share, 4) for name, share in asdict(self).items() if share}


def _percent(share: float) -> str:
    return f"{share:.0%}" if share >= 0.01 else f"{share:.1%}"


def leave_out_still(context: StageContext, masks: FrameMasks, frames: Sequence[Frame], rig: Rig) -> StillShare:
    """Find what stands still, once, so that `masks` leave it out from then on; warn of it.

    Raises InputError where it is most of the image and no poses are known.
    """
    if context.config.frames.still == "keep":
        return StillShare()
    table = masks.folder / "still.json"
    if not table.exists():
        write_json(table, asdict(_found(context, masks, frames, rig)))
    still = StillShare(**read_json(table, None))
    if still.left_out > _MOST and not context.config.frames.poses:
        raise InputError(
            f"{_percent(still.left_out)} of the image stands still while the rest moves. If the scene is what moves, "
            "as on a turntable or in a small part of a screen, leave out all else with --masks FOLDER. Otherwise the "
            f"camera stands still and there is no parallax: {HOW_TO_FILM[0].lower()}{HOW_TO_FILM[1:]}"
        )
    for warning in still.warnings:
        context.warn(warning)
    return still


def _found(context: StageContext, masks: FrameMasks, frames: Sequence[Frame], rig: Rig) -> StillShare:
    shares, veils = [], []
    for direction in range(len(rig)):
        own = [f for f in frames if f.id // rig.stations == direction]
        rows = np.unique(np.linspace(0, len(own) - 1, min(SAMPLED, len(own))).round().astype(int))
        looked_at = context.progress.track(rows.tolist(), "still parts", len(rows))
        still = find_still(masks.grey(own[i]) for i in looked_at)
        if still is not None and still.left_out.any():
            masks.save_still(still.left_out, direction)
        shares.append(0.0 if still is None else float(still.left_out.mean()))
        veils.append(0.0 if still is None else still.veil)
    return StillShare(float(np.mean(shares)), float(np.mean(veils)))
