"""Metres per unit of a run from everything that is known of it, with an honest standard deviation."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..depth.fields import DepthFields
from ..networks.card import Card
from ..networks.outputs import network_depth
from ..networks.session import Letterbox, Network
from ..run.files import CALIBRATION, CLASSES, DEPTH_FIELDS, FIGURES, FRAME_SCALES, FRAMES, PROXY_MAPS
from ..run.folder import RunFolder
from ..types import Array, Intrinsics, Metres, MetresSource, Trajectory
from .evidence import CEILING_HEIGHT, OUTDOORS, THINGS, Combined, Evidence, Mode, combine, independence
from .room import (
    MIN_CONFIDENCE,
    SeenFrame,
    build_scene,
    camera_height,
    ceiling_height,
    sizes_of_things,
    usual_distance,
)

_SENSOR_SD = 0.02
"""Depth cameras: 1 to 3 % at room distances after the factory's calibration (Khoshelham and Oude Elberink, Sensors
2012, for the Kinect)."""
_SENSOR_SPREAD = 0.02
"""Depth that strays more than this from the triangulated points, relatively, is no sensor's."""
_MIN_SD = 0.003
MEASURED = "measured"
"""Kind of what somebody has measured: a length that the user knows, a depth camera."""

SMALL_SD = 0.36
"""Root mean square of FastDepth's log errors on thirteen recordings, of each with the line of its card fitted to the
other twelve; 0.40 as it comes. What is nearer than a metre it takes for 1.3 to 1.9 m, halls for smaller rooms."""
LARGE_SD = 0.10
"""Metric3D-V2 and MoGe-2: zero-shot AbsRel of 6 to 10 % on indoor sets (their papers), of which much is the scale."""
_MIN_PIXELS = 1500
_INDEPENDENT = 6
"""Neighbouring views err alike: the median of many counts as that of so few at most."""

_MAX_FRAMES = 40
_MAX_NETWORK_FRAMES = 24
_CONTRADICTION = 3.0
_OUTDOORS_SHARE = 0.2
"""Share of an image, in the middle of all, that shows sky or open ground; through windows it is less. A judgement, not
fitted to recordings."""

_OUTDOORS_WARNING = (
    "the scene is outdoors by its labels (sky, grass, road), so its size in metres is not estimated: what the estimate "
    "knows are rooms. Give --scale-ref, or a GPS track with --gps"
)
_ROOM_WARNING = (
    "the scale assumes an indoor room (no label network, no ceiling in view); outdoors it may be off by a factor of "
    "ten. Install a label network with `msgs-slam models pull`, or give the scale with --scale-ref or --gps"
)


@dataclass(frozen=True)
class Seen:
    """Keyframes of a run, their camera, and the names of their classes; `is_named`: whether something that knows things
    gave the names."""

    frames: list[SeenFrame]
    frame_ids: list[int]
    camera: Intrinsics
    names: tuple[str, ...]
    is_named: bool

    @property
    def is_outdoors(self) -> bool:
        """Whether sky and open ground fill much of the images, where a network named what they show."""
        wanted = [i for i, name in enumerate(self.names) if name.lower() in OUTDOORS]
        if not (self.is_named and wanted and self.frames):
            return False
        return float(np.median([np.isin(f.maps.labels, wanted).mean() for f in self.frames])) > _OUTDOORS_SHARE


def find_metres(
    run: RunFolder, trajectory: Trajectory, guess: bool, card: Card | None, threads: int = 1, device: str = "cpu"
) -> tuple[Metres | None, str | None]:
    """Estimate the unit of the world of `trajectory` in metres, None where they are unknown, or could only be guessed
    although guesses are off; and a warning where there is evidence against them.

    guess: whether what is usual in the world counts; card: a network for metric depth, where there is one, on so many
    threads and "cpu" or "cuda". Raises InputError for a network that
    is not what its card says.
    """
    given = known_evidence(run)
    seen = load_seen(run, trajectory) if guess else None
    usual = [] if seen is None else usual_evidence(seen, card, threads, device)
    # What was measured needs no guesses beside it: they can only doubt it.
    pieces = given if any(p.kind == MEASURED for p in given) else [*given, *usual]
    warning = contradiction(given, usual)
    metres = describe(pieces) if pieces else None
    if given or seen is None:
        return metres, warning
    if seen.is_outdoors:
        return metres, _OUTDOORS_WARNING
    if metres is not None and not is_room(seen, usual):
        return replace(metres, only_in_room=True), _ROOM_WARNING
    return metres, warning


def is_room(seen: Seen, usual: Sequence[Evidence]) -> bool:
    """Return whether anything tells that the scene is a room: a network that would know outdoors, or a ceiling."""
    return seen.is_named or any(p.kind == CEILING_HEIGHT for p in usual)


def usual_evidence(seen: Seen, card: Card | None, threads: int = 1, device: str = "cpu") -> list[Evidence]:
    """Collect evidence of a network, the room and the things in it; none where no frame has reliable depth, nor
    outdoors, where neither the network nor what is usual in a room holds."""
    if seen.is_outdoors:
        return []
    scene = build_scene(seen.frames, seen.camera, seen.names, seen.is_named) if seen.frames else None
    if scene is None:
        return []
    found = None
    if card is not None:
        some = seen.frames[:: -(-len(seen.frames) // _MAX_NETWORK_FRAMES)]
        found = network_scale(card, some, seen.camera, threads, device)
    # A network has learned what distances are usual: beside it they would count twice.
    whole = found or usual_distance(scene)
    return [*camera_height(scene), *ceiling_height(scene), *sizes_of_things(scene), whole]


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
    """Return evidence that the unit is a metre, from whatever made the world metric; none for a run without metres."""
    report = run.load(FIGURES["proxy"])
    if not report.get("metric"):
        return []
    if report.get("scale_from") == "reference":
        sd = max(float(report["reference_relative_sd"]), _MIN_SD)
        return [Evidence("the given reference", MEASURED, (Mode(0.0, sd),), 0.0, is_guess=False)]
    # How each frame's depth strays around its points, and how exactly tracking fitted metric depth, where it did.
    spreads = [row["spread"] for row in run.find(FRAME_SCALES) or ()]
    statistical = float((run.find(FIGURES["tracking"]) or {}).get("scale_relative_sd") or 0.0)
    name = str(report.get("depth", "depth"))
    is_sensor = name.startswith("files") and (not spreads or float(np.median(spreads)) < _SENSOR_SPREAD)
    kind, wrong, own = (MEASURED, 0.0, _SENSOR_SD) if is_sensor else ("network", 0.03, LARGE_SD)
    modes = (Mode(0.0, float(np.hypot(own, statistical))),)
    return [Evidence(f"the depth of {name}", kind, modes, wrong, is_guess=False)]


def describe(pieces: Sequence[Evidence]) -> Metres:
    """The combination of the pieces, with the sources by name and what each says alone."""
    combined = combine(pieces)
    by_source = tuple(MetresSource(p.source, float(np.exp(p.log_scale)), p.sd) for p in pieces)
    return Metres(
        per_unit=combined.factor,
        relative_sd=combined.sd,
        is_guess=all(p.is_guess for p in pieces),
        sources=_names(pieces, combined),
        by_source=by_source,
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


def network_scale(
    card: Card, frames: Sequence[SeenFrame], camera: Intrinsics, threads: int, device: str
) -> Evidence | None:
    """Find the metres per unit that make the frames' depth what the network says, the median over frames; None where
    the network and the frames' reliable depth have too little in common.

    camera: intrinsics of the frames' images. Raises InputError for a network that is not what its card says.
    """
    network = Network(card, threads, device)
    small = all(card.focal)
    logs = []
    for frame in frames:
        found = (log_ratio if small else _plain)(network, frame, camera)
        if found is not None:
            logs.append(found)
    if not logs:
        return None
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(np.array(logs) - middle)))
    sd = float(np.hypot(SMALL_SD if small else LARGE_SD, spread / np.sqrt(min(len(logs), _INDEPENDENT))))
    return Evidence(f"the network {card.model.stem}", "network", (Mode(middle, sd),), wrong=0.03)


def log_ratio(network: Network, frame: SeenFrame, camera: Intrinsics) -> float | None:
    """log(metres by the network / depth in the world), the median over the reliable pixels that it saw.

    A network without a canonical focal length knows the size of things only through the camera it was trained with: it
    gets the image as that camera would have taken it, with a longer lens where the image shows less. What a lens of k
    times the focal length shows looks k times nearer, so its depth counts k times.
    """
    fx, fy = network.card.focal
    rows, columns = network.card.size
    # The view must lie in the image: what is beyond its border would be made up.
    zoom = max(1.0, columns / fx * camera.fx / camera.width, rows / fy * camera.fy / camera.height)
    own = Intrinsics(columns, rows, fx * zoom, fy * zoom, columns / 2, rows / 2)
    image = retake(frame.image, camera, own)
    output = network.run(image, Letterbox(columns, rows, columns, rows))["output"]
    metres = np.asarray(output, np.float64).reshape(rows, columns)
    low, high = network.card.valid
    rows, columns = frame.maps.depth.shape
    depth = np.where(frame.maps.confidence >= MIN_CONFIDENCE, frame.maps.depth, 0)
    depth = _warped(depth, camera.resized(columns, rows), own, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
    factor, power = network.card.metres_line
    return _median_log(np.where((metres > low) & (metres < high), factor * (metres * zoom) ** power, 0), depth)


def _plain(network: Network, frame: SeenFrame, camera: Intrinsics) -> float | None:
    """The same for a network that takes the camera into account itself."""
    maps = frame.maps
    height, width = maps.depth.shape
    image = np.asarray(cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    found = network_depth(network, image, camera.resized(width, height))
    return _median_log(found.depth.astype(np.float64), np.where(maps.confidence >= MIN_CONFIDENCE, maps.depth, 0))


def _median_log(metres: Array, depth: Array) -> float | None:
    both = (metres > 0) & (depth > 0)
    return float(np.median(np.log(metres[both] / depth[both]))) if both.sum() >= _MIN_PIXELS else None


def retake(image: NDArray[np.uint8], camera: Intrinsics, other: Intrinsics) -> NDArray[np.uint8]:
    """The image that a camera at the same place with other intrinsics would have taken; edges repeat beyond it."""
    sx, sy = other.fx / camera.fx, other.fy / camera.fy
    if min(sx, sy) < 0.75:  # linear interpolation alone would alias
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigmaX=0.4 / sx, sigmaY=0.4 / sy), np.uint8)
    return np.asarray(_warped(image, camera, other, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE), np.uint8)


def _warped(image: NDArray, camera: Intrinsics, other: Intrinsics, how: int, border: int) -> NDArray:
    sx, sy = other.fx / camera.fx, other.fy / camera.fy
    # OpenCV's pixel centres are at integers.
    shift_x = other.cx - 0.5 - sx * (camera.cx - 0.5)
    shift_y = other.cy - 0.5 - sy * (camera.cy - 0.5)
    matrix = np.array([[sx, 0, shift_x], [0, sy, shift_y]])
    return np.asarray(cv2.warpAffine(image, matrix, (other.width, other.height), flags=how, borderMode=border))
