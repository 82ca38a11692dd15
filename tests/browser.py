"""A tab of headless Chromium, driven over the browser's own protocol; and scripts of pages run by node."""

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

BROWSER = next((b for n in ("chromium", "chromium-browser", "google-chrome") if (b := shutil.which(n))), None)
HANGS = 900.0
"""Seconds after which a page is taken to hang. No test depends on how fast it answers."""
FLAGS = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


class NotReady(Exception):
    """The tab cannot answer now."""


def button(words: str) -> str:
    """The page's button with these words, as an expression of its script."""
    return f"[...document.querySelectorAll('button')].find(b => b.innerText.includes({words!r}))"


class Page:
    """One tab, driven over the browser's own protocol."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._number = socket, 0

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=HANGS))
            if answer.get("id") == self._number:
                if "error" in answer:  # a tab between two documents has no picture
                    raise NotReady(answer["error"])
                return answer["result"]

    def value(self, expression: str) -> Any:
        """What an expression of the page's script is."""
        return self.call("Runtime.evaluate", expression=expression, awaitPromise=True)["result"].get("value")

    def screenshot(self, path: Path) -> None:
        """The whole tab as a PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def scene(self) -> NDArray[np.uint8]:
        """The picture left of the controls and below the browser's notice, BGR."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[160:, :400]

    def canvas(self) -> tuple[float, float]:
        """Width and height of what the map is drawn on; it begins at the window's corner."""
        text = "JSON.stringify(['clientWidth', 'clientHeight'].map(k => document.querySelector('canvas')[k]))"
        width, height = json.loads(self.call("Runtime.evaluate", expression=text)["result"]["value"])
        return width, height

    def click(self, x: float, y: float) -> None:
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, words: str) -> None:
        """The button with these words, as a finger or a mouse would."""
        self.call("Runtime.evaluate", expression=f"{button(words)}.click()")

    def be_a_phone(self, width: int = 390, height: int = 844) -> None:
        """A screen held upright, two pixels a point, and fingers in place of a mouse."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=2, mobile=True)
        self.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)

    def fingers(self, *paths: list[tuple[float, float]]) -> None:
        """Put down a finger at the beginning of each path, move all along them, lift them; one place is a tap."""
        for step, kind in enumerate(["touchStart"] + ["touchMove"] * (len(paths[0]) - 1)):
            places = [{"x": path[step][0], "y": path[step][1], "id": n} for n, path in enumerate(paths)]
            self.call("Input.dispatchTouchEvent", type=kind, touchPoints=places)
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def tap(self, element: str) -> bool:
        """Put a finger on an element, an expression of the page's script, where the page shows it; False where it is
        hidden or covered."""
        place = (
            f"(() => {{ const e = {element}; if (!e) return; e.scrollIntoView({{block: 'nearest'}}); "
            "const b = e.getBoundingClientRect(), x = b.x + b.width / 2, y = b.y + b.height / 2; "
            "if (e.contains(document.elementFromPoint(x, y))) return JSON.stringify([x, y]); })()"
        )
        found = self.value(place)
        if found:
            self.fingers([tuple(json.loads(found))])
        return bool(found)

    def until(self, happened: Callable[[], object]) -> None:
        """Wait for it, however slow the machine is; a page that hangs fails the test."""
        end = time.monotonic() + HANGS
        while not happened():
            assert time.monotonic() < end, "the page did not answer"
            time.sleep(0.2)

    def wait_for(self, seen: Callable[[NDArray[np.uint8]], bool]) -> NDArray[np.uint8]:
        """Wait until the scene looks so; returns it."""
        found: list[NDArray[np.uint8]] = []

        def looks_so() -> bool:
            with suppress(NotReady):
                found[:] = [self.scene()]
                return seen(found[0])
            return False

        self.until(looks_so)
        return found[0]

    def wait_for_change(self, before: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Wait until the scene is clearly another one; returns it."""
        return self.wait_for(lambda picture: bool(np.abs(picture.astype(float) - before).mean() > 5))


@contextmanager
def browser(profile: Path, size: tuple[int, int] = (760, 520), *flags: str) -> Iterator[Page]:
    """A headless Chromium of its own, and its one tab."""
    connect = pytest.importorskip("websockets.sync.client").connect
    command = [str(BROWSER), *FLAGS, "--remote-debugging-port=0", "--remote-allow-origins=*"]
    process = subprocess.Popen(
        [*command, f"--user-data-dir={profile}", "--window-size={},{}".format(*size), *flags, "about:blank"],
        stderr=subprocess.DEVNULL,
    )
    try:
        port_file, end = profile / "DevToolsActivePort", time.monotonic() + HANGS
        while not (port_file.exists() and port_file.read_text().strip()):
            assert time.monotonic() < end, "the browser did not start"
            time.sleep(0.2)
        port = port_file.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            tab = next(t for t in json.load(answer) if t["type"] == "page")
        with connect(tab["webSocketDebuggerUrl"], max_size=None) as socket:
            yield Page(socket)
    finally:
        process.terminate()
        process.wait()


def in_node(scripts: str, expression: str, **values: Any) -> Any:
    """What an expression of the scripts, which may be a promise, is as JSON; `values` are names in it."""
    if not (node := shutil.which("node")):
        pytest.skip("needs node")
    given = "".join(f"const {name} = {json.dumps(value)};\n" for name, value in values.items())
    program = f"{scripts}\n{given}(async () => process.stdout.write(JSON.stringify(await {expression})))();"
    done = subprocess.run([node, "-"], input=program, capture_output=True, text=True, timeout=HANGS)
    assert done.returncode == 0, done.stderr[-1000:]
    return json.loads(done.stdout)
