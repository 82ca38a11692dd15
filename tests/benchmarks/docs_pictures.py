"""The pictures of the documentation, made anew from a finished run of the demo.

python tests/benchmarks/docs_pictures.py msgs-demo/room.msgs docs/pictures [--only wide demo_views ...] [--takes DIR]

Screenshots (report, viewer, page) need Chromium. --takes keeps the two videos of the page on filming that are refused.
"""

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.video import VideoReader
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.evaluation.report import write_report
from msgs_slam.pipelines.evaluation.write import CLIP, VIDEO
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from tests.benchmarks.first_picture import first_picture
from tests.browser import Page, browser
from tests.world import ClipOptions, World, iter_clip, make_world, render_view
from tests.world.clip import develop
from tests.world.paths import room_walk

Image = NDArray[np.uint8]
TEXEL = 0.006
TURNED, HURRIED = ClipOptions(frames=30), ClipOptions(frames=18, laps=1.0, shutter=1.0, noise=14.0)


def wide(run: RunFolder, target: Path, _: Path) -> None:
    """Frame, map, classes, mesh."""
    cv2.imwrite(str(target / "wide.jpg"), first_picture(load_outcome(run)), QUALITY)


def demo_views(run: RunFolder, target: Path, _: Path) -> None:
    """Three of the rows that `evaluate` draws, and its plot of the camera's path."""
    views = cv2.imread(str(run.root / "evaluation" / "views.png"))
    starts = np.flatnonzero((views == 255).all(axis=(1, 2)))
    head = int(starts[np.argmax(np.diff(starts) > 20)]) + 1
    row = (len(views) - head) / round((len(views) - head) / (int(starts[np.argmax(starts > head + 20)]) + 1 - head))
    rows = [views[:head], *(views[round(head + k * row) : round(head + (k + 1) * row)] for k in (0, 2, 4))]
    cv2.imwrite(str(target / "demo_views.jpg"), at_width(np.concatenate(rows), 1500), QUALITY)
    shutil.copyfile(run.root / "evaluation" / "trajectory_top.svg", target / "demo_path.svg")


def takes(run: RunFolder, target: Path, keep: Path) -> None:
    """A frame of the demo's clip, of a turn on the spot and of a hurried walk in the dark."""
    world = make_world(texel=TEXEL)
    clips = {
        VIDEO: [frame.rgb for frame in VideoReader(CLIP / VIDEO)],
        "turned.mp4": list(turned(world)),
        "hurried.mp4": [frame.rgb for frame in iter_clip(world, HURRIED)],
    }
    for name, frames in clips.items():
        write_video(keep / name, iter(frames), 10.0)
    shown = [cv2.cvtColor(frames[len(frames) // 2], cv2.COLOR_RGB2BGR) for frames in clips.values()]
    strip = np.concatenate([np.pad(s, ((0, 0), (0, 8), (0, 0)), constant_values=255) for s in shown], axis=1)
    cv2.imwrite(str(target / "takes.jpg"), strip[:, :-8], QUALITY)


def turned(world: World) -> Iterator[Image]:
    """Through 70 degrees on the spot."""
    pose = room_walk(np.array([0.05]))[0]
    for number, angle in enumerate(np.linspace(0, np.radians(70), TURNED.frames)):
        c, s = np.cos(angle), np.sin(angle)
        there = pose.copy()
        there[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ pose[:3, :3]
        yield develop(render_view(world, TURNED, there)[0], TURNED, number)


def report(run: RunFolder, target: Path, scratch: Path) -> None:
    """The top of the report."""
    page = scratch / "report.html"
    write_report(run, page)
    with browser(scratch / "profile", (1100, 1461)) as tab:
        show(tab, page.as_uri(), 3)
        save(tab, target / "report.jpg", 1100)


def page(run: RunFolder, target: Path, scratch: Path) -> None:
    """The page to send, with the tape from one thing to another."""
    path = export_run(run, scratch / "html", "html")[0]
    with browser(scratch / "profile", (1000, 562)) as tab:
        show(tab, f"{path.as_uri()}#camera=17", 8)
        tab.press("Measure")
        for place in ((400, 330), (690, 300)):
            tab.click(*place)
            time.sleep(2)
        save(tab, target / "page.jpg", 1000)


def viewer(run: RunFolder, target: Path, scratch: Path) -> None:
    """The map's page in colour and by class, side by side."""
    halves = []
    with browser(scratch / "profile", (1050, 620)) as tab:
        show(tab, run.path("export", "map.html").resolve().as_uri(), 8)
        for words in ("Colour", "Classes"):
            tab.press(words)
            time.sleep(5)
            tab.screenshot(scratch / f"{words}.png")
            halves.append(cv2.imread(str(scratch / f"{words}.png")))
    cv2.imwrite(str(target / "viewer.jpg"), at_width(np.concatenate(halves, axis=1), 1400), QUALITY)


def show(tab: Page, address: str, seconds: float) -> None:
    """Open an address, and give a browser without a GPU time to draw it."""
    tab.call("Page.enable")
    tab.call("Page.navigate", url=address)
    time.sleep(seconds)


def save(tab: Page, target: Path, width: int) -> None:
    """A screenshot as JPEG."""
    with tempfile.NamedTemporaryFile(suffix=".png") as file:
        tab.screenshot(Path(file.name))
        cv2.imwrite(str(target), at_width(cv2.imread(file.name), width), QUALITY)


def at_width(image: Image, width: int) -> Image:
    """Smaller or larger, as wide as that."""
    size = (width, round(width * image.shape[0] / image.shape[1]))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 86]
MAKERS: dict[str, Callable[[RunFolder, Path, Path], None]] = {
    f.__name__: f for f in (wide, demo_views, takes, report, viewer, page)
}


def main() -> None:
    """See the top of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--only", nargs="*", choices=MAKERS, default=list(MAKERS))
    parser.add_argument("--takes", type=Path)
    given = parser.parse_args()
    for name in given.only:
        with tempfile.TemporaryDirectory() as scratch:
            keep = given.takes if name == "takes" and given.takes else Path(scratch)
            partial(MAKERS[name], RunFolder(given.run), given.target)(keep)
            print(name)


if __name__ == "__main__":
    main()
