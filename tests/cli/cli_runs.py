"""Commands in this process, and what a tiny finished run consists of."""

import os
from dataclasses import dataclass
from pathlib import Path

from click.testing import CliRunner, Result

from msgs_slam.msgs_cli.main import main
from tests.world import ClipOptions

QUICK = (
    "run.threads=1", "run.device=cpu", "frames.max_features=600", "proxy.stereo_side=96",
    "mapping.passes=1",
    "mapping.min_iterations=20", "mapping.max_gaussians=8000", "export.voxel=0.05",
)  # fmt: skip
OPTIONS = ClipOptions(frames=14, width=160, height=120, fps=10.0, laps=0.26)


def invoke(*arguments: object) -> Result:
    """Run the command in this process. A bug's traceback is not swallowed."""
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@dataclass(frozen=True)
class FinishedRun:
    """The video, its truth as a data set, and the run folder; copy the folder before changing it."""

    video: Path
    truth: Path
    folder: Path


def kernels() -> Path:
    """Where compiled kernels are kept already, so that they need not be compiled again."""
    home = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    return Path(os.environ.get("NUMBA_CACHE_DIR") or Path(home, "msgs-slam"))


def elsewhere(root: Path) -> dict[str, str]:
    """An environment whose home, temporary and working folder are new and empty, below `root`."""
    for name in ("home", "temporary", "here"):
        (root / name).mkdir()
    places = {"HOME": root / "home", "XDG_CACHE_HOME": root / "home" / "cache", "TMPDIR": root / "temporary"}
    places |= {"NUMBA_CACHE_DIR": kernels(), "MSGS_SLAM_CACHE": root / "home" / "models"}
    return os.environ | {k: str(v) for k, v in places.items()}


def files_below(*folders: Path) -> dict[str, int]:
    """Name → time of change."""
    return {str(p): p.stat().st_mtime_ns for f in folders for p in f.rglob("*") if p.is_file()}
