"""The scale where the run is metric already (a reference, depth files, a metric network), and by a network that was
trained on metric depth."""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..networks.card import Card
from ..networks.depth import network_depth
from ..networks.session import Letterbox, Network
from ..types import Array, Intrinsics
from .evidence import Evidence, Mode
from .view import MIN_CONFIDENCE, SeenFrame

_SENSOR_SD = 0.02
"""Depth cameras: 1 to 3 % at room distances after the factory's calibration (Khoshelham and Oude Elberink, Sensors
2012, for the Kinect)."""
_SENSOR_SPREAD = 0.02
"""Depth that strays more than this from the triangulated points, relatively, is no sensor's."""
_MIN_SD = 0.003
MEASURED = "measured"
"""Kind of what somebody has measured: a length that the user knows, a depth camera."""

SMALL_SD = 0.25
"""FastDepth puts 77.1 % of the pixels of NYU Depth v2 within 25 % of the truth (Wofk et al., ICRA 2019): a Gaussian of
0.186 in log depth, most of it alike over an image. On rooms of another kind it errs more; four recordings, none of
them used to choose anything else here, gave log errors of 0.10, -0.05, -0.15 and -0.43: 0.24 root mean square."""
LARGE_SD = 0.10
"""Metric3D-V2 and MoGe-2: zero-shot AbsRel of 6 to 10 % on indoor sets (their papers), of which much is the scale."""
_ZOOMS = (1.0, 1.25, 1.5)
"""FastDepth was trained on images enlarged by 1 to 1.5, depth divided by as much: each is as good an answer."""
_MIN_PIXELS = 1500
_INDEPENDENT = 6
"""Neighbouring views err alike: the median of many counts as that of so few at most."""


def network_scale(
    card: Card, frames: Sequence[SeenFrame], camera: Intrinsics, threads: int, device: str
) -> Evidence | None:
    """Find the metres per unit that make the frames' depth what the network says, the median over frames; None where
    the network and the frames' reliable depth have too little in common.

    Args:
        card: a network for metric depth.
        frames: the keyframes it looks at.
        camera: intrinsics of their images.
        threads: of the network.
        device: "cpu" or "cuda".

    Raises InputError for a network that is not what its card says.
    """
    network = Network(card, threads, device)
    small = all(card.focal)
    logs = []
    for frame in frames:
        zooms = (
            [log_ratio(network, frame, camera, zoom) for zoom in _ZOOMS] if small else [_plain(network, frame, camera)]
        )
        known = [z for z in zooms if z is not None]
        if known:
            logs.append(float(np.mean(known)))
    if not logs:
        return None
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(np.array(logs) - middle)))
    sd = float(np.hypot(SMALL_SD if small else LARGE_SD, spread / np.sqrt(min(len(logs), _INDEPENDENT))))
    return Evidence(f"the network {card.model.stem}", "network", (Mode(middle, sd),), wrong=0.03)


def log_ratio(network: Network, frame: SeenFrame, camera: Intrinsics, zoom: float) -> float | None:
    """log(metres by the network / depth in the world), the median over the reliable pixels that it saw.

    A network without a canonical focal length knows the size of things only through the camera it was trained with: it
    gets the image as that camera, `zoom` times as long, would have taken it. What a lens of k times the focal length
    shows looks k times nearer, so its depth counts k times.
    """
    fx, fy = network.card.focal
    rows, columns = network.card.size
    # The view must lie in the image: what is beyond its border would be made up.
    zoom *= max(1.0, columns / fx * camera.fx / camera.width, rows / fy * camera.fy / camera.height)
    own = Intrinsics(columns, rows, fx * zoom, fy * zoom, columns / 2, rows / 2)
    image = retake(frame.image, camera, own)
    output = network.run(image, Letterbox(columns, rows, columns, rows))["output"]
    metres = np.asarray(output, np.float64).reshape(rows, columns)
    low, high = network.card.valid
    depth = retake_nearest(frame.maps.depth, camera, own)
    sure = retake_nearest(frame.maps.confidence, camera, own) >= MIN_CONFIDENCE
    return _median_log(np.where((metres > low) & (metres < high), metres * zoom, 0), np.where(sure, depth, 0))


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
    # OpenCV's pixel centres are at integers.
    shift_x = other.cx - 0.5 - sx * (camera.cx - 0.5)
    shift_y = other.cy - 0.5 - sy * (camera.cy - 0.5)
    matrix = np.array([[sx, 0, shift_x], [0, sy, shift_y]])
    size = (other.width, other.height)
    return np.asarray(cv2.warpAffine(image, matrix, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def retake_nearest(values: NDArray[np.float32], camera: Intrinsics, other: Intrinsics) -> Array:
    """(height, width) of `other`: the values of an image of `camera`'s view at its pixels, 0 outside it."""
    x = (np.arange(other.width) + 0.5 - other.cx) / other.fx * camera.fx + camera.cx
    y = (np.arange(other.height) + 0.5 - other.cy) / other.fy * camera.fy + camera.cy
    columns = np.floor(x * values.shape[1] / camera.width).astype(np.int64)
    rows = np.floor(y * values.shape[0] / camera.height).astype(np.int64)
    inside = ((rows >= 0) & (rows < values.shape[0]))[:, None] & ((columns >= 0) & (columns < values.shape[1]))[None]
    taken = values[np.clip(rows, 0, values.shape[0] - 1)[:, None], np.clip(columns, 0, values.shape[1] - 1)[None]]
    return np.where(inside, taken, 0).astype(np.float64)


def known_scale(report: Mapping[str, Any], spreads: list[float], statistical_sd: float) -> list[Evidence]:
    """Return evidence that the unit is a metre, from whatever made the world metric; none for a run without metres.

    report: the proxy stage's; spreads: relative spread of each frame's depth around its triangulated points;
    statistical_sd: relative deviation of the scale that tracking fitted to the depth.
    """
    if not report.get("metric"):
        return []
    if report.get("scale_from") == "reference":
        sd = max(float(report["reference_relative_sd"]), _MIN_SD)
        return [Evidence("the given reference", MEASURED, (Mode(0.0, sd),), 0.0, is_guess=False)]
    name = str(report.get("depth", "depth"))
    is_sensor = name.startswith("files") and (not spreads or float(np.median(spreads)) < _SENSOR_SPREAD)
    sd = float(np.hypot(_SENSOR_SD if is_sensor else LARGE_SD, statistical_sd))
    kind = MEASURED if is_sensor else "network"
    return [Evidence(f"the depth of {name}", kind, (Mode(0.0, sd),), 0.0 if is_sensor else 0.03, is_guess=False)]
