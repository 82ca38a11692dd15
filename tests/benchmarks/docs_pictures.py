"""The pictures of README and site, made anew from finished runs: of the demo, and of a real recording.

    python tests/benchmarks/docs_pictures.py msgs-demo/room.msgs docs/pictures --desk desk.msgs
    python tests/benchmarks/docs_pictures.py msgs-demo/room.msgs docs/pictures --only page report

desk.msgs: `msgs-slam reconstruct` of a video, 10 images a second, of every third image of TUM RGB-D's freiburg1_xyz
from number 400 on, 68 in all (CC BY 4.0; README names its authors). Screenshots (report, viewer, page) need Chromium.
--takes DIR keeps the two videos of the page on filming that are refused. `shown.json` beside the pictures says which
colours, page and report they show; a test compares it with those of today.
"""

import argparse
import hashlib
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Film

from msgs_slam.formats.glb import read_mesh_glb
from msgs_slam.formats.video import VideoReader
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.evaluation.film import render_run
from msgs_slam.pipelines.evaluation.html import STYLE
from msgs_slam.pipelines.evaluation.report import write_report
from msgs_slam.pipelines.evaluation.views import label_picture, mesh_picture, render_outcome
from msgs_slam.pipelines.evaluation.write import CLIP, VIDEO
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.export.web_page import PARTS
from msgs_slam.pipelines.providers import class_colors
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import Outcome, load_outcome
from msgs_slam.pipelines.scene.world import WORLD
from tests.browser import Page, browser
from tests.world import ClipOptions, World, iter_clip, make_world, render_view
from tests.world.clip import develop
from tests.world.paths import room_walk

Image = NDArray[np.uint8]
TEXEL = 0.006
TURNED, HURRIED = ClipOptions(frames=30), ClipOptions(frames=18, laps=1.0, shutter=1.0, noise=14.0)


def desk(run: RunFolder, target: Path, scratch: Path) -> None:
    """A film of the map as `render --path orbit` makes it; right of it a frame, and classes and mesh from there."""
    outcome = load_outcome(run)
    row = len(outcome.frames) // 2
    panels = {"video": outcome.run.image(outcome.frames[row]), **drawn(outcome, row)}
    beside = np.concatenate([titled(name, picture) for name, picture in panels.items()], axis=0)
    render_run(run, scratch / "orbit", path="orbit", fps=5.0, size=(SIDE * 4 // 3, SIDE), tell=lambda _: None)
    images = [cv2.imread(str(p))[..., ::-1] for p in sorted((scratch / "orbit").glob("*.png"))]
    shown = [Film.fromarray(np.concatenate([i, beside[: i.shape[0]]], axis=1)) for i in images]
    shown[0].save(
        target / "desk.webp", save_all=True, append_images=shown[1:], duration=120, loop=0, quality=70, method=6
    )


def drawn(outcome: Outcome, row: int) -> dict[str, Image]:
    """Classes and mesh as the camera of that frame sees them."""
    view = render_outcome(outcome, outcome.trajectory.cam_from_world[row])
    world = WORLD.read(outcome.run.file("export", "world.json"))
    mesh = read_mesh_glb(outcome.run.file("export", "mesh.glb"))
    mesh = replace(mesh, vertices=(mesh.vertices @ world.gltf_from_exported).astype(np.float32))
    moved = outcome.moved(world.exported_from_run).trajectory.cam_from_world[row]
    return {
        "labels": label_picture(view.labels, outcome.classes.colors),
        "textured mesh": mesh_picture(mesh, moved, outcome.calibration.intrinsics),
    }


def titled(name: str, picture: Image) -> Image:
    """A third of the film's height, with its name in the corner and a gap above and left."""
    size = (SIDE * 4 // 9 - GAP, SIDE // 3 - GAP)
    resized = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    for thickness, shade in ((3, (0, 0, 0)), (1, (255, 255, 255))):
        cv2.putText(resized, name, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, shade, thickness, cv2.LINE_AA)
    return np.pad(resized, ((GAP // 2, GAP // 2), (GAP, 0), (0, 0)), constant_values=255)


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


def today() -> dict[str, str]:
    """What pictures show of the program: digests of the classes' colours, the page's marks and the report's."""
    names = ("wall", "floor", "ceiling", "table", "chair", "bed", "door", "object 1", "object 2", "object 3")
    page = "".join((PARTS / name).read_text(encoding="utf-8") for name in ("page.html", "style.css"))
    texts = {"colours": str(class_colors(names)), "page": page, "report": STYLE}
    return {name: hashlib.sha256(text.encode()).hexdigest()[:16] for name, text in texts.items()}


SHOWN = {
    "desk.webp": ["colours"], "demo_views.jpg": ["colours"], "viewer.jpg": ["colours", "page"], "page.jpg": ["page"],
    "report.jpg": ["colours", "report"],
}  # fmt: skip
"""What of `today` is to be seen in a picture."""
SIDE, GAP = 405, 4
QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 86]
MAKERS: dict[str, Callable[[RunFolder, Path, Path], None]] = {
    f.__name__: f for f in (desk, demo_views, takes, report, viewer, page)
}


def main() -> None:
    """See the top of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--desk", type=Path, help="the finished run of the real recording")
    parser.add_argument("--only", nargs="*", choices=MAKERS, default=list(MAKERS))
    parser.add_argument("--takes", type=Path)
    given = parser.parse_args()
    kept = given.target / "shown.json"
    for name in given.only:
        run = given.desk if name == "desk" else given.run
        if run is None:
            parser.error("desk.webp needs --desk, or leave it out by --only")
        with tempfile.TemporaryDirectory() as scratch:
            MAKERS[name](
                RunFolder(run), given.target, given.takes if name == "takes" and given.takes else Path(scratch)
            )
        known = json.loads(kept.read_text()) if kept.exists() else {}
        new = {picture: {k: today()[k] for k in SHOWN[picture]} for picture in SHOWN if picture.startswith(f"{name}.")}
        kept.write_text(json.dumps(dict(sorted((known | new).items())), indent=1) + "\n")
        print(name)


if __name__ == "__main__":
    main()
