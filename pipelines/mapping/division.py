"""Which frames the map is made of, and into how many submaps memory divides it; imports nothing that computes."""

from ..config import Config
from ..run.files import CALIBRATION, TRAJECTORY
from ..run.folder import RunFolder
from ..system.machine import submap_size
from ..types import Trajectory


def mapping_division(run: RunFolder, config: Config) -> int:
    """Return the number of submaps; more for less memory."""
    kept, _ = split_frames(run.load(TRAJECTORY, "tracking"), config.mapping.hold_out)
    return submap_count(len(kept), submap_size(config, run.load(CALIBRATION).intrinsics))


def submap_count(keyframes: int, size: int) -> int:
    """Return the number of submaps for this many keyframes."""
    return max(1, round(keyframes / size)) if size else 1


def split_frames(trajectory: Trajectory, hold_out: int) -> tuple[list[int], list[int]]:
    """(ids of keyframes to use, ids held out of the placed frames: every `hold_out`-th, from half of that on)."""
    posed = trajectory.frame_ids[trajectory.is_placed].tolist()
    keyframes = trajectory.frame_ids[trajectory.is_keyframe].tolist()
    if hold_out <= 0:
        return keyframes, []
    held = [i for i in posed if i % hold_out == hold_out // 2]
    return [i for i in keyframes if i not in set(held)], held
