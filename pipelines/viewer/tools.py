"""The viewer's tools: which Gaussians are shown (classes, a box), what is saved of them, and a measuring tape."""

import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.ply import write_gaussian_ply
from ..geometry.tape import Touch, area, area_text, tape, tape_text, touch
from ..types import VOID
from .scene import ViewerScene, client_view

_SETTLE_SECONDS = 0.25
"""A slider is dragged through many values; the map is sent again once it rests."""
_RED = (220, 38, 38)
_LIFT = 0.06
"""Of the scene as shown, which is about five long."""


class Selection:
    """Switches for classes and a box; `changed` is called when what is shown has changed."""

    def __init__(self, server: Any, scene: ViewerScene, changed: Callable[[], None]) -> None:
        self._server, self._scene, self._changed = server, scene, changed
        self.classes: dict[int, Any] = {}
        self._deleted: list[NDArray[np.bool_]] = []
        self._pending: threading.Timer | None = None
        if scene.labels is not None:
            with server.gui.add_folder("Classes", expand_by_default=False):
                self._add_classes(scene.labels)
        with server.gui.add_folder("Crop", expand_by_default=False):
            self._add_box()
        hide = server.gui.add_button(f"Delete visible {scene.what}", hint="Until undone; no file changes", color="gray")
        hide.on_click(lambda _: self.delete())
        self.undo_button = server.gui.add_button("Undo delete", color="gray", visible=False)
        self.undo_button.on_click(lambda _: self.undo())
        save = server.gui.add_button(
            f"Save visible {scene.what} (.ply)", hint="In the coordinates of the exported files", color="gray"
        )
        save.on_click(lambda event: self.save(event.client))

    @property
    def rows(self) -> NDArray[np.bool_]:
        """(M,) which Gaussians are shown."""
        shown = np.ones(len(self._scene.cloud), bool)
        if self._scene.labels is not None:
            table = np.ones(256, bool)
            for label, switch in self.classes.items():
                table[label] = switch.value
            shown &= table[self._scene.labels]
        if self.crop.value:
            low, high = np.array([s.value for s in self.box]).T
            shown &= ((self._scene.cloud.means >= low) & (self._scene.cloud.means <= high)).all(axis=1)
        for rows in self._deleted:
            shown &= ~rows
        return shown

    def delete(self) -> None:
        """Hide what is shown, whatever the switches and the box say."""
        if (rows := self.rows).any():
            self._deleted.append(rows)
            self.undo_button.visible = True
            self._soon()

    def undo(self) -> None:
        """Bring back what was deleted last."""
        if self._deleted:
            self._deleted.pop()
            self.undo_button.visible = bool(self._deleted)
            self._soon()

    def ply(self) -> bytes:
        """Return what is shown as the bytes of a splat PLY, in the world of the exported files."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "seen.ply"
            write_gaussian_ply(path, self._scene.cloud.only(self.rows), self._scene.class_names)
            return path.read_bytes()

    def save(self, client: Any) -> None:
        """The browser gets it as a download."""
        if self.rows.any():
            client.send_file_download(f"{Path(self._scene.title).stem}-seen.ply", self.ply(), save_immediately=True)

    def _add_classes(self, labels: NDArray[np.uint8]) -> None:
        counts = np.bincount(labels, minlength=256)
        buttons = self._server.gui.add_button_group("All", ("on", "off"))
        buttons.on_click(lambda _: self._switch_all(buttons.value == "on"))
        for label in sorted(np.flatnonzero(counts).tolist(), key=lambda k: -counts[k]):
            switch = self._server.gui.add_checkbox(f"{class_name(self._scene, label)} ({counts[label]:,})", True)
            switch.on_update(lambda _: self._soon())
            self.classes[label] = switch

    def _switch_all(self, on: bool) -> None:
        for switch in self.classes.values():
            switch.value = on
        self._soon()

    def _add_box(self) -> None:
        gui = self._server.gui
        low, high = np.quantile(self._scene.cloud.means, (0.001, 0.999), axis=0).tolist()
        self.crop = gui.add_checkbox("Only what is in the box", False)
        self.crop.on_update(lambda _: self._soon())
        self.box = []
        gui.add_markdown(unit_text(self._scene))
        for axis, a, b in zip("xyz", low, high, strict=True):
            bottom, top, step = round_range(a, b)
            slider = gui.add_multi_slider(axis, bottom, top, step, (bottom, top))
            slider.on_update(lambda _: self._soon())
            self.box.append(slider)

    def rest(self) -> None:
        """Nothing is sent any more of what was changed a moment ago."""
        if self._pending is not None:
            self._pending.cancel()

    def _soon(self) -> None:
        self.rest()
        self._draw_box()
        self._pending = threading.Timer(_SETTLE_SECONDS, self._changed)
        self._pending.daemon = True
        self._pending.start()

    def _draw_box(self) -> None:
        low, high = np.array([s.value for s in self.box]).T * self._scene.scale
        size = tuple(float(v) for v in high - low)
        self._server.scene.add_box(
            "/crop", _RED, size, wireframe=True, position=(low + high) / 2, visible=bool(self.crop.value)
        )


def round_range(low: float, high: float) -> tuple[float, float, float]:
    """A range around both with a step of a power of ten, so that a slider shows few digits: 0.01 for a room."""
    power = int(np.floor(np.log10(max(high - low, 1e-6) / 50)))
    step, digits = 10.0**power, max(-power, 0)
    return round(float(np.floor(low / step)) * step, digits), round(float(np.ceil(high / step)) * step, digits), step


def class_name(scene: ViewerScene, label: int) -> str:
    """The name of a label of the scene's Gaussians."""
    return "unknown" if label == VOID or label >= len(scene.class_names) else scene.class_names[label]


def length_text(length: float, scene: ViewerScene) -> str:
    """A length without its uncertainty."""
    if scene.is_metric or scene.metres is None:
        return f"{length:.2f} {'m' if scene.is_metric else 'units'}"
    return f"{length:.2f} units ≈ {length * scene.metres.per_unit:.2g} m"


def unit_text(scene: ViewerScene) -> str:
    """Say in a line what lengths are given in."""
    if scene.is_metric:
        return "Lengths are metres."
    if scene.metres is None:
        return "Lengths have no known unit."
    return f"1 unit ≈ {scene.metres.per_unit:.2g} m ± {100 * scene.metres.relative_sd:.0f} %"


class Tape:
    """Two clicks on the map: a line with the distance and its standard deviation; or more, for the area between them.
    Each place tells its height over the floor, where there is one.

    viser 1.1 takes no finger's tap on the scene for a click (a touched canvas holds its pointer from the start), so a
    button marks what is in the middle of the view.
    """

    def __init__(self, server: Any, scene: ViewerScene, selection: Selection) -> None:
        self._server, self._scene, self._selection = server, scene, selection
        self._places: list[Touch] = []
        self.result = ""
        with server.gui.add_folder("Measure"):
            self.switch = server.gui.add_checkbox("Measuring tape", False, hint="Click two places of the map")
            self.kind = server.gui.add_dropdown("Measure", ("length", "area"), visible=False)
            self._middle = server.gui.add_button(
                "Mark the middle", hint="Instead of a click; for fingers", visible=False
            )
            self.told = server.gui.add_markdown("")
        self.kind.on_update(lambda _: self._turn(bool(self.switch.value)))
        self._middle.on_click(lambda event: self.mark_middle(event.client))
        self.switch.on_update(lambda _: self._turn(bool(self.switch.value)))

    def click(self, event: Any) -> None:
        """A place that the event's line of sight meets."""
        self._place(np.asarray(event.ray_origin, np.float64), np.asarray(event.ray_direction, np.float64), event.client)

    def mark_middle(self, client: Any) -> None:
        """Take the place in the middle of the client's view."""
        pose = client_view(client)
        self._place(pose[:3, 3], pose[:3, 2], client)

    def _place(self, origin: NDArray[np.float64], direction: NDArray[np.float64], client: Any) -> None:
        """One end of the tape more, or one corner of an area."""
        pixel = float(client.camera.fov) / max(int(client.camera.image_height), 1)
        cloud = self._scene.cloud.only(self._selection.rows)
        found = touch(cloud, origin / self._scene.scale, direction / np.linalg.norm(direction), pixel)
        if found is None:
            self.told.content = "No surface there: click on the map."
            return
        if self.kind.value == "length" and len(self._places) == 2:
            self._places = []
            self._server.scene.remove_by_name("/tape")
        self._places.append(found)
        place = found.point * self._scene.scale
        self._server.scene.add_icosphere(f"/tape/{len(self._places)}", 0.03, _RED, position=place)
        self._tell()

    def _turn(self, on: bool) -> None:
        self._server.scene.remove_click_callback()
        self._server.scene.remove_by_name("/tape")
        self._middle.visible = self.kind.visible = on
        asked = "Click two places of the map" if self.kind.value == "length" else "Click the corners of an area"
        self._places, self.result, self.told.content = [], "", f"{asked}, or mark the middle of the view." if on else ""
        if on:
            self._server.scene.on_click()(self.click)

    def _tell(self) -> None:
        """In words, and as a line on the map, what the places come to."""
        places, scene = np.stack([t.point for t in self._places]), self._scene
        self.result = ""
        if self.kind.value == "length" and len(places) == 2:
            self.result = tape_text(*tape(*self._places), scene.is_metric, scene.metres)
        elif self.kind.value == "area" and len(places) > 2:
            self.result = area_text(area(places), scene.is_metric, scene.metres)
        last = self._places[-1]
        height = tape_text(float(last.point[2]), last.sd(np.array([0.0, 0, 1])), scene.is_metric, scene.metres)
        more = "Click the second place." if self.kind.value == "length" else "Click the next corner."
        told = [f"**{self.result}**" if self.result else more, f"{height} over the floor" if scene.has_floor else ""]
        self.told.content = "\n\n".join(line for line in told if line)
        if len(places) > 1:
            self._stretch()

    def _stretch(self) -> None:
        # A little towards the eye, else what it is stretched over covers it.
        ends = np.stack([t.point * self._scene.scale - _LIFT * t.direction for t in self._places]).astype(np.float32)
        ways = np.stack([ends, np.roll(ends, -1, axis=0)], axis=1)[: 1 if len(ends) == 2 else None]
        scene = self._server.scene
        scene.add_line_segments("/tape/line", ways, _RED, thickness=3.0, thickness_units="screen")
        if self.result:
            scene.add_label("/tape/text", self.result, position=ends.mean(axis=0))
