"""Writes the clip that `msgs-slam demo` comes with: python -m tests.world.demo_clip"""

import tempfile
import zipfile
from pathlib import Path

from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.evaluation.write import CLIP, TRUTH, VIDEO
from tests.world import ClipOptions, iter_clip, make_world, write_sequence

OPTIONS = ClipOptions(frames=36, width=320, height=240, fps=10.0, laps=0.32)
TEXEL = 0.006


def pack_clip(folder: Path, video: Path, truth: Path) -> Path:
    """A clip as `unpack_demo_clip` takes it; its pictures are those of the video. Returns `folder`."""
    (folder / VIDEO).write_bytes(video.read_bytes())
    with zipfile.ZipFile(folder / f"{TRUTH}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(p for p in truth.rglob("*") if p.is_file() and p.parent.name != "rgb"):
            # A name alone: the time of writing would make every archive another one.
            archive.writestr(zipfile.ZipInfo(path.relative_to(truth).as_posix()), path.read_bytes())
    return folder


if __name__ == "__main__":
    world = make_world(texel=TEXEL)
    frames = list(iter_clip(world, OPTIONS))
    with tempfile.TemporaryDirectory() as temporary:
        video = write_video(Path(temporary) / VIDEO, (f.rgb for f in frames), OPTIONS.fps)
        truth = write_sequence(Path(temporary) / TRUTH, world, OPTIONS, frames)
        pack_clip(CLIP, video, truth)
