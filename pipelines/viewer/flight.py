"""The viewer's tool for a camera path: keyframes at the current view, a preview of the flight, a file for `render`."""

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from ..system.wording import quoted
from .camera_path import CameraPath, Keyframe
from .scene import ViewerScene, client_view, move_client, shown_pose

_GREEN = (22, 163, 74)
_PREVIEW_FPS, _LINE_FPS = 25.0, 8.0
_FRUSTUM = 0.14


class Flight:
    """Records keyframes, shows them with the spline between them, plays the flight and saves it."""

    def __init__(self, server: Any, scene: ViewerScene) -> None:
        self._server, self._scene = server, scene
        self.keyframes: list[Keyframe] = []
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        gui = server.gui
        with gui.add_folder("Camera path", expand_by_default=False):
            gui.add_button("Add keyframe", hint="At the current view", color="gray").on_click(
                lambda event: self.add(event.client)
            )
            self.chosen = gui.add_dropdown("Keyframe", ("1",), visible=False)
            self.visit_button = gui.add_button("Go to keyframe", color="gray", visible=False)
            self.delete_button = gui.add_button("Delete keyframe", color="gray", visible=False)
            self.seconds = gui.add_number("Seconds per keyframe", 2.0, min=0.1, max=60.0, step=0.1)
            self.fps = gui.add_number("Images per second", 30, min=1, max=240, step=1)
            self.play_button = gui.add_button("Play", color="gray", visible=False)
            self.save_button = gui.add_button("Download (.json)", color="gray", visible=False)
            self.told = gui.add_markdown("")
        self.visit_button.on_click(lambda event: self.visit(event.client))
        self.delete_button.on_click(lambda _: self.delete())
        self.play_button.on_click(lambda event: self.play(event.client))
        self.save_button.on_click(lambda event: self.save(event.client))
        for box in (self.seconds, self.fps):
            box.on_update(lambda _: self._tell())
        self._changed(0)

    @property
    def path(self) -> CameraPath:
        """The path as it is by now."""
        return CameraPath(tuple(self.keyframes), float(self.fps.value), float(self.seconds.value), self._scene.world)

    def add(self, client: Any) -> None:
        """A keyframe after the chosen one, at the client's view."""
        pose = client_view(client)
        pose[:3, 3] /= self._scene.scale
        at = min(self._index + 1, len(self.keyframes))
        self.keyframes.insert(at, Keyframe(pose, float(np.degrees(client.camera.fov))))
        self._changed(at)

    def take(self, keyframes: list[Keyframe]) -> None:
        """Go on with keyframes that were recorded in the same world."""
        self.keyframes = keyframes
        self._changed(max(len(keyframes) - 1, 0))

    def delete(self) -> None:
        """Without the chosen keyframe."""
        if self.keyframes:
            del self.keyframes[self._index]
            self._changed(max(self._index - 1, 0))

    def visit(self, client: Any) -> None:
        """Look from the chosen keyframe."""
        key = self.keyframes[self._index]
        move_client(client, key.world_from_cam, self._scene.scale, float(np.radians(key.fov)))

    def play(self, client: Any) -> None:
        """Fly along the path in real time, or end the flight that is on."""
        if self._thread is not None and self._thread.is_alive():
            self._stop.set()
            return
        self._stop.clear()
        self._thread = threading.Thread(target=self._fly, args=(client, self.path), daemon=True)
        self._thread.start()

    def save(self, client: Any) -> None:
        """The browser gets the path as a download."""
        name = f"{Path(self._scene.title).stem}-path.json"
        client.send_file_download(name, self.path.to_json().encode(), save_immediately=True)
        source = "FILE" if self._scene.run is None else "RUN"
        self.told.content = f"Render it with `msgs-slam render {source} out.mp4 --path {quoted(name)}`."

    def rest(self) -> None:
        """End the flight that is on."""
        self._stop.set()

    @property
    def _index(self) -> int:
        return int(self.chosen.value) - 1

    def _fly(self, client: Any, path: CameraPath) -> None:
        poses, fovs = path.flight(_PREVIEW_FPS)
        self._show(False)  # one would fly through them
        self.play_button.label = "Stop"
        start = time.monotonic()
        while not self._stop.is_set() and (i := int((time.monotonic() - start) * _PREVIEW_FPS)) < len(poses):
            move_client(client, poses[i], self._scene.scale, float(np.radians(fovs[i])))
            self._stop.wait(1 / _PREVIEW_FPS)
        if not self._stop.is_set():
            move_client(client, poses[-1], self._scene.scale, float(np.radians(fovs[-1])))
        self.play_button.label = "Play"
        self._show(True)

    def _changed(self, chosen: int) -> None:
        """List, buttons and what is drawn, after a keyframe has come or gone."""
        self.chosen.options = tuple(str(i + 1) for i in range(max(len(self.keyframes), 1)))
        self.chosen.value = str(chosen + 1)
        for handle in (self.chosen, self.visit_button, self.delete_button):
            handle.visible = bool(self.keyframes)
        self.play_button.visible = self.save_button.visible = len(self.keyframes) > 1
        self._tell()
        self._show(True)

    def _tell(self) -> None:
        count = len(self.keyframes)
        if count < 2:
            self.told.content = "Add keyframes at two views or more."
            return
        path = self.path
        seconds = (count - 1) * path.seconds_per_keyframe
        self.told.content = f"{count} keyframes, {seconds:.1f} s, {path.image_count():,} images"

    def _show(self, visible: bool) -> None:
        """Draw a frustum with its number for each keyframe, and the line that the camera will follow."""
        scene, scale = self._server.scene, self._scene.scale
        scene.remove_by_name("/flight")
        if not visible:
            return
        for number, key in enumerate(self.keyframes, 1):
            wxyz, position = shown_pose(key.world_from_cam, scale)
            scene.add_camera_frustum(
                f"/flight/{number}", float(np.radians(key.fov)), 1.5, scale=_FRUSTUM, color=_GREEN, thickness=2.0,
                thickness_units="screen", wxyz=wxyz, position=position,
            )  # fmt: skip
            scene.add_label(f"/flight/{number}/label", str(number))
        if len(self.keyframes) > 1:
            line = self.path.flight(_LINE_FPS)[0][:, :3, 3] * scale
            pairs = np.stack([line[:-1], line[1:]], axis=1).astype(np.float32)
            scene.add_line_segments("/flight/line", pairs, _GREEN, thickness=3.0, thickness_units="screen")
