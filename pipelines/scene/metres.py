"""Metres per unit of a run from everything that is known of it, with an honest standard deviation."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..depth.fields import DepthFields
from ..networks.card import Card
from ..run.files import CALIBRATION, CLASSES, DEPTH_FIELDS, FIGURES, FRAME_SCALES, FRAMES, PROXY_MAPS
from ..run.folder import RunFolder
from ..types import Intrinsics, Metres, MetresSource, Trajectory
from .evidence import CEILING_HEIGHT, OUTDOORS, THINGS, Combined, Evidence, combine, independence
from .heights import camera_height, ceiling_height, sizes_of_things, usual_distance
from .network import MEASURED, known_scale, network_scale
from .view import Scene, SeenFrame, build_scene

_MAX_FRAMES = 40
_MAX_NETWORK_FRAMES = 24
_CONTRADICTION = 3.0
_OUTDOORS_SHARE = 0.2
"""Share of an image, in the middle of all, that shows sky or open ground; through windows it is less. A judgement, not
fitted to recordings."""


@dataclass(frozen=True)
class Seen:
    """Keyframes of a run, their camera, and the names of their classes; `is_named`: whether something that knows things
    gave the names."""

    frames: list[SeenFrame]
    frame_ids: list[int]
    camera: Intrinsics
    names: tuple[str, ...]
    is_named: bool


def find_metres(
    run: RunFolder, trajectory: Trajectory, guess: bool, card: Card | None, threads: int = 1, device: str = "cpu"
) -> tuple[Metres | None, str | None]:
    """Estimate the unit of the world of `trajectory` in metres, None where they are unknown, or could only be guessed
    although guesses are off; and a warning where there is evidence against them.

    Args:
        run: the run, with its proxy maps.
        trajectory: poses in the world whose unit is asked for.
        guess: whether what is usual in the world counts.
        card: a network for metric depth, where there is one.
        threads: of the network.
        device: "cpu" or "cuda".

    Raises InputError for a network that is not what its card says.
    """
    given = known_evidence(run)
    seen = load_seen(run, trajectory) if guess else None
    usual = [] if seen is None else usual_evidence(seen, card, threads, device)
    # What was measured needs no guesses beside it: they can only doubt it.
    pieces = given if any(p.kind == MEASURED for p in given) else [*given, *usual]
    warning = contradiction(given, usual)
    if seen is not None and not given and is_outdoors(seen):
        warning = (
            "the scene is outdoors by its labels (sky, grass, road), so its size in metres is not estimated: what the "
            "estimate knows are rooms. Give --scale-ref, or a GPS track with --gps"
        )
    metres = describe(pieces) if pieces else None
    if metres is not None and seen is not None and not given and not is_room(seen, usual):
        metres = replace(metres, only_in_room=True)
        warning = (
            "no label network tells what the images show, and no ceiling is in them: the estimated size holds if the "
            "scene is a room; outdoors it may be wrong by ten times. `msgs-slam models pull` brings a label network; "
            "--scale-ref or --gps give the size itself"
        )
    return metres, warning


def is_room(seen: Seen, usual: Sequence[Evidence]) -> bool:
    """Return whether anything tells that the scene is a room: a network that would know outdoors, or a ceiling."""
    return seen.is_named or any(p.kind == CEILING_HEIGHT for p in usual)


def is_outdoors(seen: Seen) -> bool:
    """Whether sky and open ground fill much of the images, where a network named what they show."""
    wanted = [i for i, name in enumerate(seen.names) if name.lower() in OUTDOORS]
    if not (seen.is_named and wanted and seen.frames):
        return False
    return float(np.median([np.isin(f.maps.labels, wanted).mean() for f in seen.frames])) > _OUTDOORS_SHARE


def usual_evidence(seen: Seen, card: Card | None, threads: int = 1, device: str = "cpu") -> list[Evidence]:
    """Collect evidence of a network, the room and the things in it; none where no frame has reliable depth, nor
    outdoors, where neither the network nor what is usual in a room holds."""
    if is_outdoors(seen):
        return []
    scene = build_scene(seen.frames, seen.camera, seen.names, seen.is_named) if seen.frames else None
    if scene is None:
        return []
    pieces = scene_evidence(scene)
    if card is not None:
        some = seen.frames[:: -(-len(seen.frames) // _MAX_NETWORK_FRAMES)]
        found = network_scale(card, some, seen.camera, threads, device)
        pieces += [found] if found else []
    return pieces


def scene_evidence(scene: Scene) -> list[Evidence]:
    """Collect the evidence of the room itself."""
    return [*camera_height(scene), *ceiling_height(scene), *sizes_of_things(scene), usual_distance(scene)]


def load_seen(run: RunFolder, trajectory: Trajectory) -> Seen:
    """Keyframes with maps, evenly spread."""
    stage = next((s for s in ("global_ba", "tracking") if run.holds(DEPTH_FIELDS, s)), None)
    fields = run.load(DEPTH_FIELDS, stage) if stage else DepthFields({})
    frame_of = {f.id: f for f in run.load(FRAMES)}
    keys = np.flatnonzero(trajectory.is_keyframe)
    rows = [int(k) for k in keys if run.holds(PROXY_MAPS, of=int(trajectory.frame_ids[k]))]
    frames, frame_ids = [], []
    for row in rows[:: max(1, -(-len(rows) // _MAX_FRAMES))]:
        frame_id = int(trajectory.frame_ids[row])
        maps = fields.in_world(frame_id, run.load(PROXY_MAPS, of=frame_id))
        frames.append(SeenFrame(run.image(frame_of[frame_id]), maps, trajectory.world_from_cam[row]))
        frame_ids.append(frame_id)
    is_named = run.load(FIGURES["proxy"]).get("semantics") != "segments"
    return Seen(frames, frame_ids, run.load(CALIBRATION).intrinsics, run.load(CLASSES).names, is_named)


def known_evidence(run: RunFolder) -> list[Evidence]:
    """Return evidence of whatever made the world metric; none where it is not."""
    # How each frame's depth strays around its points, and how exactly tracking fitted metric depth, where it did.
    spreads = [row["spread"] for row in run.find(FRAME_SCALES) or ()]
    tracked = run.find(FIGURES["tracking"])
    statistical = 0.0 if tracked is None else float(tracked.get("scale_relative_sd") or 0.0)
    proxy = run.load(FIGURES["proxy"])
    return known_scale(proxy, spreads, statistical)


def describe(pieces: Sequence[Evidence]) -> Metres:
    """The combination of the pieces, with the sources by name and what each says alone."""
    combined = combine(pieces)
    alone = tuple(MetresSource(p.source, float(np.exp(p.log_scale)), p.sd) for p in pieces)
    return Metres(
        per_unit=combined.factor,
        relative_sd=combined.sd,
        is_guess=all(p.is_guess for p in pieces),
        sources=_names(pieces, combined),
        alone=alone,
        disagreement=combined.disagreement,
    )


def _names(pieces: Sequence[Evidence], combined: Combined) -> tuple[str, ...]:
    """The sources that the result rests on, most telling first; alike ones counted; what is refuted left out."""
    weight: dict[str, float] = defaultdict(float)
    count: Counter[str] = Counter()
    for piece, power in zip(pieces, independence(pieces), strict=True):
        if float(piece.distance(np.array([combined.log_scale]))[0]) < _CONTRADICTION:
            weight[piece.source] += power / min(m.sd for m in piece.modes) ** 2
            count[piece.source] += 1
    if len(weight) > 1:
        weight.pop("usual distances", None)
    return tuple(_counted(count[name], name) for name in sorted(weight, key=lambda n: -weight[n]))


def _counted(count: int, source: str) -> str:
    """ "door" → "1 door", "2 doors"; what is no thing stays as it is."""
    if source not in THINGS:
        return source
    return f"{count} {source}{'' if count == 1 else 'es' if source.endswith('ch') else 's'}"


def contradiction(given: Sequence[Evidence], usual: Sequence[Evidence]) -> str | None:
    """Return a warning where the given metres are far from everything that is usual; None where they are not."""
    if not given or not usual:
        return None
    known, guessed = combine(given), combine(usual)
    if abs(known.log_scale - guessed.log_scale) < _CONTRADICTION * np.hypot(known.sd, guessed.sd):
        return None
    times = float(np.exp(guessed.log_scale - known.log_scale))
    return (
        f"{given[0].source} makes the scene implausible in size: {', '.join(_names(usual, guessed))} say that lengths "
        f"are {times:.2g} times as large, give or take {guessed.sd:.0%}. Check its unit"
    )
