"""The page of a map served to this machine's browser, and loaded again whenever the run has more to show."""

from __future__ import annotations

import hashlib
import json
import threading
from dataclasses import replace
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

import numpy as np
import torch

from ...formats.errors import InputError
from ...formats.reading import read_bytes
from ..config import STAGES
from ..export.kinds import WEB_PAGE
from ..export.web_page import PARTS, page_of
from ..geometry.sparse_model import SparseModel
from ..render.gaussian_map import GaussianMap
from ..run.files import BACKBONE, CALIBRATION, FRAMES
from ..run.folder import RunFolder
from ..run.manifest import recorded_config
from ..run.outcome import Outcome, load_outcome, runs_of_pieces
from ..run.progress import load_run_progress
from ..run.reads import StageRecord
from ..scene.world import WORLD, Upright, in_world, up_in_run, upright_world
from ..system.progress import log
from ..system.wording import quoted
from ..types import ClassTable, Trajectory

_HOST = "127.0.0.1"
_NAMES = {_HOST, "localhost"}
"""Under another name a page from the web could be asking: a name of its own can be pointed here (DNS rebinding)."""
_SHOWING = {
    "frames": "cameras and points after frames", "tracking": "cameras and points after tracking",
    "mapping": "the map after mapping", "global_ba": "the map after global_ba",
}  # fmt: skip
_POINT_RADIUS, _POINT_OPACITY = 0.0024, 4.0
"""Of a point before there is a map: radius in sizes of the scene, opacity as a logit."""
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; frame-src 'self'"
)
_HEADERS = {
    "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff", "X-Frame-Options": "SAMEORIGIN",
    "Cross-Origin-Resource-Policy": "same-origin",
}  # fmt: skip
_NOTHING = "<!doctype html><meta charset=utf-8><body style='font:15px sans-serif;color:#ddd;background:#000'>{}"


def progress_summary(run: RunFolder) -> str:
    """Say in a line what is shown of a run and what is still to come; "" for a finished one."""
    records = run.records
    left = [name for name in STAGES if name not in records]
    if not left:
        return ""
    shown = next((text for name, text in reversed(_SHOWING.items()) if name in records), "nothing yet")
    running = load_run_progress(run)
    if running is None:
        what = f"{', '.join(left)}. No job is running: `msgs-slam resume {quoted(run.place.name)}` continues"
    else:
        what = ", ".join(f"{name} ({running.text})" if name == running.stage else name for name in left)
    return f"Shown: {shown} ({len(STAGES) - len(left)} of {len(STAGES)} stages done). Still to come: {what}."


def page_of_run(run: RunFolder) -> str:
    """Return the page of what a run has by now: its map as exported, its map, or its cameras and points.

    Raises InputError for what is damaged, and where nothing can be shown yet.
    """
    records = run.records
    if run.has("export", WEB_PAGE):
        return read_bytes(run.file("export", WEB_PAGE)).decode("utf-8")
    outcome = load_outcome(run) if "tracking" in records else _after_frames(run, records)
    if outcome.gaussian_map is None:
        outcome = _with_points(outcome, outcome.load_sparse())
    if not len(outcome.require_map()):
        raise InputError(f"{run.root} has no Gaussians to show")
    if (world := outcome.run.find(WORLD) if "export" in records else None) is not None:
        return page_of(in_world(outcome, world), world)
    world = upright_world(outcome, Upright(up_in_run(outcome), "cameras", None))
    elements = "Gaussians" if "mapping" in records else "points"
    return page_of(outcome.moved(world.exported_from_run), world, is_exported=False, elements=elements)


def _after_frames(run: RunFolder, records: dict[str, StageRecord]) -> Outcome:
    """Keyframes and points of structure from motion. Raises InputError before they are found."""
    model = run.find(BACKBONE) if "frames" in records else None
    if model is None or not len(model.frame_ids):
        raise InputError(f"{run.root} has nothing to show yet")
    frames, count = run.load(FRAMES), len(model.frame_ids)
    times = np.array([frames[i].timestamp for i in model.frame_ids])
    trajectory = Trajectory(model.frame_ids, times, model.cam_from_world, np.ones(count, bool), ("",) * count)
    outcome = Outcome(
        run, records, recorded_config(records, run.settings()), frames, run.load(CALIBRATION), "frames", trajectory,
        "", None, ClassTable((), ()), np.zeros(0, np.uint8), None, False, "", (),
    )  # fmt: skip
    return _with_points(outcome, model)


def _with_points(outcome: Outcome, model: SparseModel | None) -> Outcome:
    """The same with small balls for a map. Raises InputError without any points."""
    if model is None or not (count := len(model.points_in_world)):
        raise InputError(f"{outcome.run.root} has nothing to show yet")
    size = np.ptp(np.quantile(model.points_in_world, (0.05, 0.95), axis=0), axis=0).max()
    balls = GaussianMap(
        means=torch.from_numpy(model.points_in_world.astype(np.float32)),
        log_radii=torch.full((count,), float(np.log(_POINT_RADIUS * max(size, 1e-9)))),
        opacity_logits=torch.full((count,), _POINT_OPACITY),
        colors=torch.from_numpy((model.colors / 255).astype(np.float32)),
        class_logits=torch.zeros((count, 0)),
        anchor_frame_ids=torch.zeros(count, dtype=torch.int64),
    )
    return replace(outcome, gaussian_map=balls)


class PageServer(ThreadingHTTPServer):
    """Serves the pages of a run and of its pieces on this machine alone, and nothing else that lies in the run."""

    daemon_threads = True

    def __init__(self, run: RunFolder, port: int = 0) -> None:
        """port: 0 = any that is free. Raises InputError for a folder that is no run, and a port that is taken."""
        run.required()
        self.run, self._lock = run, threading.Lock()
        self._pages: dict[str, tuple[str, str]] = {}
        try:
            super().__init__((_HOST, port), _Handler)
        except OSError as error:
            raise InputError(f"port {port} cannot be used ({error.strerror}): choose another with --port") from error

    @property
    def url(self) -> str:
        """The address to open in a browser."""
        return f"http://{_HOST}:{self.server_port}/"

    def parts(self) -> dict[str, RunFolder]:
        """Return the run and its pieces that have a map, by the names that they are served under."""
        pieces = runs_of_pieces(self.run, self.run.records)
        return {"map": self.run} | {p.place.name: p for p in pieces if "mapping" in p.records}

    def state(self) -> str:
        """Return as JSON what is said of the run, and a number for each part that changes with what its page shows."""
        try:
            versions = {name: _version(run) for name, run in self.parts().items()}
            return json.dumps({"text": progress_summary(self.run), "parts": versions})
        except InputError as error:  # a stage that is made again just now
            return json.dumps({"text": str(error), "parts": None})

    def page(self, part: str) -> str:
        """Return the page of a part, made anew where the run has changed."""
        with self._lock:
            run = self.parts()[part]
            now = _version(run)
            shown, page = self._pages.get(part, ("", ""))
            if shown != now:
                try:
                    page = page_of_run(run)
                except InputError as error:
                    page = _NOTHING.format(escape(str(error)))
                self._pages[part] = now, page
            return page


def _version(run: RunFolder) -> str:
    """Changes with the files of every stage whose results are shown."""
    seen = {name: record.content for name, record in run.records.items() if name != "proxy"}
    return hashlib.sha256(json.dumps(seen).encode()).hexdigest()[:16]


class _Handler(BaseHTTPRequestHandler):
    server: PageServer

    def do_GET(self) -> None:
        hosts = self.headers.get_all("Host", [])
        try:
            is_here = [urlsplit(f"//{host}").hostname in _NAMES for host in hosts] == [True]
        except ValueError:
            is_here = False
        if not is_here:
            return self._answer(403, "text/plain", "This server answers to 127.0.0.1 and localhost only.\n")
        name = urlsplit(self.path).path.removeprefix("/")
        try:
            if name == "":
                frame = (PARTS / "live.html").read_text(encoding="utf-8")
                page = frame.replace("{{title}}", escape(self.server.run.place.name))
                return self._answer(200, "text/html", page, _POLICY)
            if name == "state":
                return self._answer(200, "application/json", self.server.state())
            if name in self.server.parts():
                return self._answer(200, "text/html", self.server.page(name))
        except InputError as error:
            return self._answer(503, "text/plain", f"{error}\n")
        return self._answer(404, "text/plain", "There is no such page.\n")

    def _answer(self, status: int, kind: str, text: str, policy: str = "") -> None:
        body = text.encode()
        self.send_response(status)
        more = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body))}
        for name, value in {**more, **_HEADERS, **({"Content-Security-Policy": policy} if policy else {})}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        log.debug("%s " + format, self.address_string(), *args)
