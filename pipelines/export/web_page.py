"""The map as one HTML file that opens from the disk, without a server or a network, on a computer and on a phone.

The page holds the Gaussians and a renderer of its own for them (`page/`, WebGL 2): isotropic ones are circles on the
screen, a square each, sorted by depth. What it draws is what `render` draws, up to the 8 bits of a screen.
"""

import base64
import gzip
import json
import re
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import require_room, write_text
from ...formats.splats import GaussianCloud, morton_order
from ..geometry.camera import rig_of
from ..run.folder import RunFolder
from ..run.outcome import Outcome, map_cloud, spread_sample
from ..run.target import Target
from ..scene.world import SAME, Z_UP_FROM_Y_DOWN, World
from ..types import VOID
from .inventory import NO_THINGS, FoundThings, Thing
from .kinds import WEB_PAGE
from .scene import ExportScene

MAX_GAUSSIANS = 1_500_000
"""About 20 MB of page, what can be sent by mail; of larger maps the least visible are left out."""
_MIN_BYTES = 10
"""A Gaussian's in the page; 13 in the rooms measured."""
MAX_CAMERAS, MAX_THINGS = 120, 255
EXPORTED, RUN = "exported", "run"
"""Worlds of a camera path: that of the exported files, and that of a run without an export."""
PARTS = Path(__file__).parent / "page"
_SCRIPTS = ("cloud.js", "draw.js", "moves.js", "look.js", "tape.js", "record.js", "things.js", "page.js")


def write_web_page(scene: ExportScene, target: Target) -> None:
    """Write map.html; nothing without Gaussians. Raises DiskFullError beforehand where there is no room for it."""
    count = len(scene.outcome.require_map())
    require_room(target.folder / WEB_PAGE, _MIN_BYTES * min(count, MAX_GAUSSIANS))
    if count:
        write_text(target.path(WEB_PAGE), page_of(scene.outcome, scene.world, things=scene.things))


def page_of(
    outcome: Outcome,
    world: World,
    is_exported: bool = True,
    elements: str = "Gaussians",
    things: FoundThings = NO_THINGS,
) -> str:
    """Return the page of a map that is in `world` and holds one Gaussian at least.

    is_exported: camera paths are recorded in the coordinates of the exported files, else in the run's own; elements:
    what the page calls the Gaussians; things: those that can be chosen in it.
    """
    cloud = map_cloud(outcome)
    cloud = replace(cloud, things=things.of(cloud.means))
    upright = np.eye(3) if world.axes == "up" else Z_UP_FROM_Y_DOWN
    back = SAME if is_exported else world.exported_from_run.inverse()
    about, packed = pack_cloud(cloud, upright)
    about |= _classes(cloud, outcome) | _cameras(outcome, upright)
    about["unit"] = {"metric": outcome.metric or world.earth is not None}
    if (metres := outcome.metres) is not None:
        text = f"{metres.text[0].upper()}{metres.text[1:]}."
        about["unit"] |= {"per_unit": metres.per_unit, "relative_sd": metres.relative_sd, "text": text}
    about["floor"] = world.has_floor
    about["things"] = [_thing(thing, upright) for thing in things.table if thing.number <= MAX_THINGS]
    about |= {"elements": elements, "recorded": {
        "world": EXPORTED if is_exported else RUN,
        "turn": (back.rotation @ upright.T).ravel().tolist(), "shift": back.translation.tolist(),
    }}  # fmt: skip
    return _page(_title(outcome.run), about, packed)


def pack_cloud(cloud: GaussianCloud, upright: NDArray[np.float64]) -> tuple[dict[str, Any], bytes]:
    """Pack a cloud for `cloud.js`: ranges for reading it, and 14 bytes per Gaussian, one plane per byte, gzipped.

    A position is 16 bits of a logarithm per axis, as a difference to the Gaussian before it in Morton order; radius,
    opacity, colour, class, thing and how sure the class is take 8 bits each. The same cloud gives the same bytes.
    """
    total, opacity = len(cloud), 1 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))
    if total > MAX_GAUSSIANS:
        visible = opacity * np.exp(2 * cloud.log_scales[:, 0].astype(np.float64))
        cloud = cloud.only(np.sort(np.argsort(-visible, kind="stable")[:MAX_GAUSSIANS]))
    means = cloud.means.astype(np.float64) @ upright.T
    order = morton_order(means)
    cloud, means = cloud.only(order), means[order]
    logs, radii = np.sign(means) * np.log1p(np.abs(means)), cloud.log_scales[:, 0].astype(np.float64)
    low, high, smallest, largest = logs.min(axis=0), logs.max(axis=0), radii.min(), radii.max()
    steps = np.round((logs - low) / np.maximum(high - low, 1e-12) * 65535).astype(np.uint16)
    differences = np.diff(steps, axis=0, prepend=np.zeros((1, 3), np.uint16))  # modulo 65536
    planes = [plane for k in range(3) for plane in (differences[:, k] >> 8, differences[:, k] & 255)]
    planes.append(np.round((radii - smallest) / max(largest - smallest, 1e-12) * 255))
    planes += list(np.round(255 * cloud.colors.clip(0, 1)).T)
    planes.append(np.round(255 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))))
    planes.append(np.full(len(cloud), VOID, np.uint8) if cloud.class_ids is None else cloud.class_ids)
    things = np.zeros(len(cloud), np.uint16) if cloud.things is None else cloud.things
    planes.append(np.where(things <= MAX_THINGS, things, 0))
    sure = np.ones(len(cloud)) if cloud.class_probs is None else cloud.class_probs.max(axis=1)
    planes.append(np.round(255 * sure / max(sure.max(), 1e-9)))
    packed = gzip.compress(np.stack(planes).astype(np.uint8).tobytes(), compresslevel=6, mtime=0)
    about = {
        "count": len(cloud), "total": total, "low": low.tolist(), "high": high.tolist(),
        "log_radii": [float(smallest), float(largest)], "middle": np.median(means, axis=0).tolist(),
    }  # fmt: skip
    return about, packed


def _classes(cloud: GaussianCloud, outcome: Outcome) -> dict[str, Any]:
    """Name, colour and share of the Gaussians of each class; none where the map has no classes."""
    if cloud.class_ids is None:
        return {"classes": []}
    shares = np.bincount(cloud.class_ids, minlength=256) / len(cloud)
    table = zip(outcome.classes.names, outcome.classes.colors, shares.tolist(), strict=False)
    return {"classes": [{"name": n, "color": list(color), "share": round(share, 5)} for n, color, share in table]}


def _thing(thing: Thing, upright: NDArray[np.float64]) -> dict[str, Any]:
    """What the page says of a thing, and its box."""
    center, axes = upright @ np.array(thing.center), np.array(thing.axes) @ upright.T
    return {
        "n": thing.number, "name": thing.name, "called": thing.class_share, "text": thing.size_text,
        "views": thing.views, "sure": thing.sure,
        "center": np.round(center, 4).tolist(), "axes": np.round(axes, 5).tolist(), "size": list(thing.size),
    }  # fmt: skip


def _cameras(outcome: Outcome, upright: NDArray[np.float64]) -> dict[str, Any]:
    """Some cameras in order, all their places, and the frame of an image: sides over focal length."""
    t, k = outcome.trajectory, outcome.calibration.intrinsics
    stations = rig_of(outcome.calibration.directions, len(outcome.frames)).stations
    rows = [int(row) for row in np.flatnonzero(t.is_posed) if t.frame_ids[row] < stations]
    centers = t.centers @ upright.T
    means = outcome.require_map().means.cpu().numpy().astype(np.float64) @ upright.T
    middle = np.median(means, axis=0) if not rows else centers[rows[0]]
    return {
        "path": np.round(centers[rows], 4).tolist(),
        "cameras": [
            {
                "n": int(t.frame_ids[row]),
                "p": np.round(centers[row], 6).tolist(),
                "r": np.round(t.cam_from_world[row][:3, :3] @ upright.T, 7).ravel().tolist(),
                "t": round(float(t.timestamps[row]), 3),
            }
            for row in spread_sample(rows, MAX_CAMERAS)
        ],
        "slope": [k.width / k.fx, k.height / k.fy],
        "shift": [(k.cx - k.width / 2) / k.fx, (k.cy - k.height / 2) / k.fy],
        "depth": float(np.median(np.linalg.norm(means - middle, axis=1))),
    }


def _title(run: RunFolder) -> str:
    """The source's name: that of the run's folder would give two runs of one source other bytes."""
    manifest = run.manifest()
    return run.place.stem if manifest is None else Path(manifest.source.path).stem


def _page(title: str, about: dict[str, Any], packed: bytes) -> str:
    parts = {
        "title": escape(title),
        "style": (PARTS / "style.css").read_text(encoding="utf-8"),
        "about": json.dumps(about, separators=(",", ":")).replace("<", "\\u003c"),
        "map": base64.b64encode(packed).decode("ascii"),
        "script": "\n".join((PARTS / name).read_text(encoding="utf-8") for name in _SCRIPTS),
    }
    frame = (PARTS / "page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], frame)
