"""An interactive view of a map in the browser, on viser (the optional extra `viewer`)."""

from __future__ import annotations

import functools
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...formats.errors import InputError, install_extra
from ..export.extra.floor_plan import walls_of_run
from ..source.sharpness import at_most_wide
from .flight import Flight
from .live import RunWatcher
from .request_guard import guard_server
from .scene import MODES, POINTS, ViewerCamera, ViewerScene, client_view, load_scenes, move_client, shown_pose
from .tools import Selection, Tape, class_name, length_text, unit_text

_FRUSTUM = 0.09
_PREVIEW_WIDTH = 480
_HELP = "Drag: turn. Right drag: move. Wheel: zoom. W A S D, Q E: fly. Two fingers: move and zoom."
_GREY, _RED = "gray", (220, 38, 38)
"""Buttons of equal weight: none of them is what the page is for."""

_P = ParamSpec("_P")
_R = TypeVar("_R")


def _alone(method: Callable[Concatenate[Viewer, _P], _R]) -> Callable[Concatenate[Viewer, _P], _R]:
    """A method of the viewer that no other such method runs beside: the page's callbacks, timers and the watch of a
    run are threads, and a scene that one of them swaps is the one that another shows."""

    @functools.wraps(method)
    def locked(self: Viewer, *args: _P.args, **named: _P.kwargs) -> _R:
        with self._lock:
            return method(self, *args, **named)

    return locked


def open_viewer(path: Path, host: str = "127.0.0.1", port: int = 8080) -> Viewer:
    """Serve a run folder or a Gaussian PLY at http://host:port; returns at once.

    Raises InputError without viser, for a path that cannot be shown, or a port that is taken.
    """
    scenes = load_scenes(path)
    try:
        import viser
    except ImportError as error:
        raise InputError(f"the viewer needs viser: {install_extra('viewer')}") from error
    try:
        with guard_server(host):
            server = viser.ViserServer(
                host=host, port=port, label=f"MSGS-SLAM {strip_markup(scenes[0].title)}", verbose=False
            )
    except OSError as error:
        raise InputError(f"port {port} cannot be used ({error.strerror}): choose another with --port") from error
    return Viewer(server, scenes)


class Viewer:
    """The map as splats, the camera path with a frustum a keyframe, the mesh, the controls for them and the tools; of
    one scene at a time, the first of `scenes` to begin with."""

    def __init__(self, server: Any, scenes: list[ViewerScene]) -> None:
        self.server, self.scenes = server, scenes
        self.watch: RunWatcher | None = None
        self._told = ""
        server.gui.configure_theme(show_logo=False)
        self.boxes: dict[str, Any] = {}
        self._lock = threading.RLock()
        self.selection: Selection | None = None
        self._load(scenes[0])
        self._add_controls()
        self._add_tools()
        server.on_client_connect(self._place)
        if (run := scenes[0].run) is not None:
            self.watch = RunWatcher(run, self.tell, self.replace)

    def _load(self, scene: ViewerScene) -> None:
        """Everything of the scene, and nothing else."""
        self.scene = scene
        self.server.scene.reset()
        self.server.scene.set_up_direction(scene.up)
        self.show(MODES[0])
        self._cameras = [self._add_camera(i, camera) for i, camera in enumerate(scene.cameras)]
        self._path = self._add_path()
        self._show_cameras(scene.what == POINTS)  # in front of a map they hide it
        self._mesh = self._add_mesh()

    @_alone
    def choose(self, number: int) -> None:
        """Show another scene, as it begins."""
        self._remove_tools()
        self._load(self.scenes[number])
        self._add_tools()
        self.mode.value = MODES[0]
        for name, box in self.boxes.items():
            box.value = name.startswith("Show") or (name == "Cameras" and self.scene.what == POINTS)
        for client in self.server.get_clients().values():
            self._place(client)

    @_alone
    def replace(self, scenes: list[ViewerScene]) -> None:
        """Show other scenes, as after another stage of the run: all controls are made anew. Whoever looks at the same
        world keeps the view, and the camera path its keyframes."""
        old, keyframes = self.scene, self.flight.keyframes
        self._remove_tools()
        self.server.gui.reset()
        self.boxes.clear()
        vars(self).pop("legend", None)
        self.scenes = scenes
        self._load(scenes[0])
        self._add_controls()
        self._add_tools()
        stays = old.world == self.scene.world and not old.is_empty
        if stays:
            self.flight.take(keyframes)
        for client in self.server.get_clients().values():
            if stays:
                client.camera.position = np.asarray(client.camera.position) * self.scene.scale / old.scale
            else:
                self._place(client)

    @_alone
    def tell(self, text: str) -> None:
        """Put a line above the controls: what is shown of an unfinished run, and what is to come."""
        self._told = re.sub(r"[<>{}\[\]\\]", "?", text)  # of a folder's name, which the page could take for its own
        if self.standing.content != self._told:
            self.standing.content, self.standing.visible = self._told, bool(self._told)

    @property
    def url(self) -> str:
        """The address to open in a browser."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    @_alone
    def show(self, mode: str, client: Any = None) -> None:
        """Colour the Gaussians by one of `MODES`; depth is seen from where `client` looks, else the first camera."""
        s = self.scene
        if "legend" in vars(self):
            self.legend.content, self.legend.visible = legend_html(s), mode == "classes"
        colors = s.depth_colors(*self._eye(client)) if mode == "depth" else s.colors[mode]
        rows = np.arange(len(s.cloud)) if self.selection is None else np.flatnonzero(self.selection.rows)
        box = self.boxes.get(f"Show {s.what}")
        visible = len(rows) > 0 and (box is None or bool(box.value))
        rows = rows if len(rows) else np.zeros(1, np.int64)  # a page cannot be sent none
        self._splats = self.server.scene.add_gaussian_splats(
            "/map", s.centers[rows], s.covariances[rows], colors[rows].astype(np.float32) / 255,
            s.opacities[rows], visible=visible,
        )  # fmt: skip

    def _eye(self, client: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(position, direction of view) as shown."""
        if client is not None:
            pose = client_view(client)
            return pose[:3, 3], pose[:3, 2]
        if self.scene.cameras:
            world_from_cam = self.scene.cameras[0].world_from_cam
            return world_from_cam[:3, 3] * self.scene.scale, world_from_cam[:3, 2]
        outside, middle = self._outside()
        return outside, (middle - outside) / np.linalg.norm(middle - outside)

    def _outside(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where to look from at a scene without cameras, and where to: in front of it and a little above."""
        middle, up = np.median(self.scene.centers, axis=0).astype(np.float64), self.scene.up
        ahead = np.array([0.0, 1, 0]) if abs(up[2]) > 0.5 else np.array([0.0, 0, 1])
        return middle + 2 * up - 7 * ahead, middle

    def wait(self) -> None:
        """Until the process is interrupted."""
        self.server.sleep_forever()

    def stop(self) -> None:
        """End the server and its timers."""
        if self.watch is not None:
            self.watch.stop()
        self._remove_tools()
        self.server.stop()

    def _add_controls(self) -> None:
        gui = self.server.gui
        titles = [f"{strip_markup(s.title)}: {0 if s.is_empty else len(s.centers):,} {s.what}" for s in self.scenes]
        if len(titles) == 1:
            gui.add_markdown("**{}**: {}".format(*titles[0].rsplit(": ", 1)))
        else:
            self.pieces = gui.add_dropdown("Piece", titles)
            self.pieces.on_update(lambda _: self.choose(titles.index(self.pieces.value)))
        self.standing = gui.add_markdown(self._told, visible=bool(self._told))
        modes = tuple(m for m in MODES if m in self.scene.colors or m == "depth")
        self.mode = gui.add_dropdown(self.scene.what.capitalize(), modes)
        self.mode.on_update(lambda event: self.show(self.mode.value, event.client))
        self.legend = gui.add_html("", visible=False)
        depth_here = gui.add_button("Colour by depth from this view", color=_GREY)
        depth_here.on_click(self._show_depth)
        gui.add_button("Reset view", color=_GREY).on_click(lambda event: self._place(event.client))
        gui.add_button("From above", color=_GREY).on_click(lambda event: self._look_down(event.client))
        self._checkbox(f"Show {self.scene.what}", True, self._show_splats)
        if self._cameras:
            self._checkbox("Cameras", self.scene.what == POINTS, self._show_cameras)
        if any(scene.mesh_file for scene in self.scenes):
            self._checkbox("Mesh", False, self._show_mesh)
            self._checkbox("Floor plan", False, self._show_floor_plan)
        if self.scene.cameras:
            blank = np.full((30, 40, 3), 235, np.uint8)
            self.preview = gui.add_image(blank, label="Camera image", format="jpeg", visible=False)
        hint = "Click a camera to look from it and see its image. " if self.scene.cameras else ""
        gui.add_markdown(f"{unit_text(self.scene)}\n\n{hint}{_HELP}")

    def _add_tools(self) -> None:
        self._tools = self.server.gui.add_folder("Tools")
        with self._tools:
            self.selection = Selection(self.server, self.scene, lambda: self.show(self.mode.value))
            self.tape = Tape(self.server, self.scene, self.selection)
            self.flight = Flight(self.server, self.scene)

    @_alone
    def _remove_tools(self) -> None:
        if self.selection is not None:
            self.tape.switch.value = False
            self.selection.rest()
            self.flight.rest()
            self._tools.remove()
            self.selection = None

    @_alone
    def _show_depth(self, event: Any) -> None:
        self.mode.value = "depth"
        self.show("depth", event.client)

    def _checkbox(self, name: str, start: bool, change: Callable[[bool], None]) -> None:
        box = self.boxes[name] = self.server.gui.add_checkbox(name, start)
        box.on_update(lambda _: change(bool(box.value)))

    @_alone
    def _show_splats(self, on: bool) -> None:
        self._splats.visible = on

    @_alone
    def _show_cameras(self, on: bool) -> None:
        for handle in [*self._cameras, *([self._path] if self._path is not None else [])]:
            handle.visible = on

    @_alone
    def _show_mesh(self, on: bool) -> None:
        if self._mesh is not None:
            self._mesh.visible = on

    @_alone
    def _show_floor_plan(self, on: bool) -> None:
        """Walls as lines over the map, with their lengths; the box goes off where there are none to show."""
        self.server.scene.remove_by_name("/walls")
        if not on:
            return
        try:
            walls = walls_of_run(self.scene.run) if self.scene.run is not None else []
        except InputError as error:
            self.server.gui.add_markdown(strip_markup(str(error)))
            self.boxes["Floor plan"].value = False
            return
        top = float(np.quantile(self.scene.cloud.means[:, 2], 0.99))
        ends = np.stack([np.column_stack([wall.ends, (top, top)]) for wall in walls]) * self.scene.scale
        lines = ends.astype(np.float32)
        self.server.scene.add_line_segments("/walls/lines", lines, _RED, thickness=4.0, thickness_units="screen")
        for number, wall in enumerate(walls):
            told = f"{wall.sign}{length_text(wall.length, self.scene)}"
            self.server.scene.add_label(f"/walls/{number}", told, position=ends[number].mean(axis=0))

    def _add_camera(self, number: int, camera: ViewerCamera) -> Any:
        wxyz, position = shown_pose(camera.world_from_cam, self.scene.scale)
        handle = self.server.scene.add_camera_frustum(
            f"/cameras/{number:05d}", camera.fov, camera.aspect, scale=_FRUSTUM, color=(37, 99, 235),
            thickness=1.5, thickness_units="screen", wxyz=wxyz, position=position,
        )  # fmt: skip
        handle.on_click(lambda event: None if self.tape.switch.value else self.visit(camera, event.client))
        return handle

    @_alone
    def visit(self, camera: ViewerCamera, client: Any) -> None:
        """Look from a camera, as after a click on it, and show its frame."""
        if client is not None:
            move_client(client, camera.world_from_cam, self.scene.scale, camera.fov)
            if self.mode.value == "depth":
                self.show("depth", client)
        if self.scene.run is not None:
            label = f"{strip_markup(camera.frame.name)}, {camera.frame.timestamp:.2f} s"
            try:
                self.preview.image = at_most_wide(self.scene.run.image(camera.frame), _PREVIEW_WIDTH)
                self.preview.visible = True
            except InputError as error:  # this frame alone: what else is shown was checked
                label = strip_markup(str(error))
            self.preview.label = label

    @_alone
    def _place(self, client: Any) -> None:
        """At the first camera, where the map is at its best, or outside a scene without cameras."""
        if self.scene.cameras:
            first = self.scene.cameras[0]
            move_client(client, first.world_from_cam, self.scene.scale, first.fov)
            return
        client.camera.position, client.camera.look_at = self._outside()

    @_alone
    def _look_down(self, client: Any) -> None:
        """From so high that the whole scene is seen, what the first camera saw ahead at the top."""
        middle, up = np.median(self.scene.centers, axis=0).astype(np.float64), self.scene.up
        ahead = self.scene.cameras[0].world_from_cam[:3, 2] if self.scene.cameras else np.array([0.0, 1, 0])
        ahead = ahead - (ahead @ up) * up
        with client.atomic():
            # Not quite straight down: there the page would not know what is up in its picture.
            client.camera.position = middle + 8 * up - 0.02 * ahead / max(float(np.linalg.norm(ahead)), 1e-9)
            client.camera.look_at = middle

    def _add_path(self) -> Any:
        if len(self.scene.path) < 2:
            return None
        pairs = np.stack([self.scene.path[:-1], self.scene.path[1:]], axis=1).astype(np.float32)
        return self.server.scene.add_line_segments(
            "/path", pairs, (234, 88, 12), thickness=2.0, thickness_units="screen"
        )

    def _add_mesh(self) -> Any:
        if self.scene.mesh_file is None:
            return None
        wxyz = Rotation.from_matrix(self.scene.world_from_mesh).as_quat()[[3, 0, 1, 2]]
        data = self.scene.mesh_file.read_bytes()
        return self.server.scene.add_glb("/mesh", data, scale=self.scene.scale, wxyz=wxyz, visible=False)


def legend_html(scene: ViewerScene) -> str:
    """A swatch, the name and the share of each class that occurs, largest first; "" without classes."""
    if scene.labels is None:
        return ""
    counts, table = np.bincount(scene.labels, minlength=256), dict(enumerate(scene.class_colors))
    rows = []
    for label in sorted(np.flatnonzero(counts).tolist(), key=lambda k: -counts[k]):
        color = "rgb({},{},{})".format(*table.get(label, (128, 128, 128)))
        swatch = (
            f"<span style='display:inline-block;width:12px;height:12px;border-radius:3px;background:{color}'></span>"
        )
        rows.append(
            f"<div>{swatch} {strip_markup(class_name(scene, label))} "
            f"{100 * counts[label] / len(scene.labels):.0f} %</div>"
        )
    return f"<div style='font-size:0.8em;padding:0 0.75em 0.5em'>{''.join(rows)}</div>"


def strip_markup(name: str) -> str:
    """A name without what Markdown, HTML or the page's scripts could take for their own."""
    return re.sub(r"[^\w .,()-]", "?", name)
