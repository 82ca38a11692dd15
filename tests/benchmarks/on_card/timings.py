"""What the card's kernels take beside the CPU's, and how many launches and reads of the host there are."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from renderer import POSE, Case

import msgs_slam.pipelines.depth.stereo.matching as matching
from msgs_slam.pipelines.depth.stereo import cuda
from msgs_slam.pipelines.depth.stereo.consistency import fuse_depths
from msgs_slam.pipelines.depth.stereo.volume import Bands
from msgs_slam.pipelines.render.api import render
from msgs_slam.pipelines.system.threads import get_threads
from on_card.rows import Rows, first_seconds, milliseconds, wait
from on_card.scenes import CARD, CPU, REHEARSAL, SIZES, Place, mapper, step, stereo_scene, world_of

BACK_TO_BACK = 2 if REHEARSAL else 30
"""Visits without a wait in between."""


def time_renderer(rows: Rows) -> None:
    """Compositing forward with all classes and with gradients of colours, and the whole rendering, of every room."""
    for row in SIZES.rows:
        size = f"{row[0]}x{row[1]}, {row[2]}, {row[3]}"
        for place, backend in ((CARD, "cuda"), (CPU, "cpu")):
            with rows.attempt(f"time of {size} on {place.name}"), place.used():
                case = Case(*row, torch.device(place.device))
                first = first_seconds(lambda case=case, backend=backend: case.forward_backward(backend), place.device)
                _add(rows, size, "composite", place, lambda c=case, b=backend: c.forward(b), first=round(first, 2))
                _add(rows, size, "composite and gradient of colours", place,
                     lambda c=case, b=backend: c.forward_backward(b))  # fmt: skip
                _add(rows, size, "render and gradient", place, _rendering(row, place))


def _rendering(row: tuple[int, int, int, int], place: Place) -> Callable[[], object]:
    leaves, k = world_of(row, place)

    def run() -> object:
        image = render(*leaves, POSE, k)
        images = list(vars(image).values())
        return torch.autograd.grad(images, leaves, [torch.ones_like(x) for x in images])

    return run


def _add(rows: Rows, case: str, of: str, place: Place, task: Callable[[], object], **more: Any) -> None:
    rows.add("timings", case=case, of=of, place=place.name, ms=milliseconds(task, place.device, SIZES.repeats), **more)


def time_mapping(rows: Rows) -> None:
    """A visit and what is done once a pass, beside the counts of `launches.py`."""
    counted = _expected(rows)
    case = f"{SIZES.size[0]}x{SIZES.size[1]}, {SIZES.gaussians} Gaussians"
    for place in (CARD, CPU):
        with rows.attempt(f"mapping on {place.name}"), place.used():
            optimiser = mapper(place)
            tasks: dict[str, Callable[[], object]] = {
                "a visit": lambda o=optimiser: o.step(step(1)),
                "a visit that notes weights and errors": lambda o=optimiser: o.step(step(1, note=True)),
                f"classes counted, {SIZES.views} views": optimiser.count_labels,
            }
            for of, task in tasks.items():
                _add(rows, case, of, place, task)
            several = lambda task=tasks["a visit"]: [task() for _ in range(BACK_TO_BACK)]  # noqa: E731
            each = milliseconds(several, place.device, 2, warm=1) / BACK_TO_BACK
            rows.add("timings", case=case, of="a visit, back to back", place=place.name, ms=each)
            if place is CARD:
                optimiser.state.settle_poses()
                for of, task in tasks.items():
                    profile(rows, of, task, counted.get(of, {}))


def time_stereo(rows: Rows) -> None:
    """A keyframe matched with its neighbours and its depth compared with theirs."""
    scene, threads = stereo_scene(), get_threads()
    case = f"{SIZES.stereo_size[0]}x{SIZES.stereo_size[1]}, {SIZES.planes} planes"
    given = (scene.depth, scene.others, scene.warps, scene.back, 0.01)
    with rows.attempt("stereo on the card"):
        match, fuse = (
            lambda: cuda.match_planes(scene.images, scene.planes, CARD.device),
            lambda: cuda.fuse_depths(*given, CARD.device),
        )
        _add(rows, case, "match", CARD, match)
        _add(rows, case, "fuse", CARD, fuse)
        profile(
            rows, "stereo of a keyframe", lambda: (match(), fuse()), _expected(rows).get("stereo of a keyframe", {})
        )
    with rows.attempt("stereo on the CPU"):
        bands = Bands(threads)
        _add(rows, case, "match", CPU, lambda: matching.match_planes(scene.images, scene.planes, bands))
        _add(rows, case, "fuse", CPU, lambda: fuse_depths(*given, bands))
        bands.close()


def _expected(rows: Rows) -> dict[str, dict[str, int]]:
    """The counts of `launches.py`, where they are known."""
    counts = rows.path.with_name("launches.json")
    return dict(json.loads(counts.read_text())) if counts.exists() else {}


def profile(rows: Rows, of: str, task: Callable[[], object], expected: dict[str, int]) -> None:
    """Add a row of what the card did for one task, and one for each of its kernels."""
    activities = [torch.profiler.ProfilerActivity.CPU]
    if CARD.device == "cuda":
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    task()
    wait(CARD.device)
    with rows.attempt(f"profile of {of}"):
        with torch.profiler.profile(activities=activities) as profiler:
            task()
            wait(CARD.device)
        with tempfile.TemporaryDirectory() as folder:
            profiler.export_chrome_trace(trace := f"{folder}/trace.json")
            events = json.loads(Path(trace).read_text())["traceEvents"]
        found = _sums(events)
        rows.add("launches", of=of, **found["all"], expected=expected)
        for name, (count, microseconds) in sorted(found["kernels"].items(), key=lambda x: -x[1][1])[:16]:
            rows.add("kernels", of=of, kernel=name[:60], count=count, microseconds=round(microseconds, 1))


def _sums(events: list[dict[str, Any]]) -> dict[str, Any]:
    """Launches, copies with their bytes, waits and busy microseconds; kernels: name → count and microseconds."""
    kernels: dict[str, tuple[int, float]] = {}
    whole = dict.fromkeys(("kernels", "fills", "copies to", "bytes to", "copies from", "bytes from", "waits"), 0)
    busy = 0.0
    for event in events:
        kind, name = event.get("cat", ""), event.get("name", "")
        if kind in ("kernel", "gpu_memcpy", "gpu_memset"):
            busy += event["dur"]
        if kind == "kernel":
            whole["kernels"] += 1
            count, spent = kernels.get(name, (0, 0.0))
            kernels[name] = count + 1, spent + event["dur"]
        elif kind == "gpu_memset":
            whole["fills"] += 1
        elif kind == "gpu_memcpy" and ("HtoD" in name or "DtoH" in name):
            way = "to" if "HtoD" in name else "from"
            whole[f"copies {way}"] += 1
            whole[f"bytes {way}"] += int(event.get("args", {}).get("bytes", 0))
        elif kind.startswith("cuda") and "StreamSynchronize" in name:
            whole["waits"] += 1
    return {"all": {**whole, "busy_us": round(busy, 1)}, "kernels": kernels}
