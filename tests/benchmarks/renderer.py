"""Times the renderer's backends on test rooms, each beside the plain-torch reference of the same run.

    python tests/benchmarks/renderer.py                       the table
    python tests/benchmarks/renderer.py --json rows.json      the same as rows
    python tests/benchmarks/renderer.py --iteration --pose --memory --first-use

Backends take turns, so that whatever else the machine does slows all of them: the ratios are what to look at.
"""

# ruff: noqa: E402 (an environment variable must be set before torch is imported)

import os

os.environ.setdefault(
    "OMP_WAIT_POLICY", "passive"
)  # before torch: idle OpenMP threads would spin on the kernels' cores

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/pipelines/render")]

import reference
import torch
from render_scenes import room
from torch import Tensor

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.mapping import losses
from msgs_slam.pipelines.mapping.losses import photo_loss
from msgs_slam.pipelines.render.api import Rendering, choose_backend, composite, project_map, render
from msgs_slam.pipelines.system.threads import set_threads

ROWS = [(320, 240, 50_000, 8), (320, 240, 200_000, 8), (640, 480, 200_000, 8), (640, 480, 200_000, 40)]
BACKENDS = {"reference": reference}
WANTED = [8.2, 8.8, 12.3, 7.9]
"""How many times faster than the reference forward + backward should be: 0.72 of a C++/OpenMP program's lead."""

POSE = se3.exp(torch.tensor([0.03, -0.02, 0.04, 0.01, -0.02, 0.005], dtype=torch.float64))


def timed(task: Callable[[], object], device: torch.device) -> float:
    """Milliseconds."""
    if device.type == "cuda":
        torch.cuda.synchronize()
    start = time.perf_counter()
    task()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - start)


class Case:
    """One room on one device: projected Gaussians whose colours have gradients, and a gradient for every image.

    Classes are drawn without gradients: mapping counts them. `forward_backward_of_all` is with those of classes too.
    """

    def __init__(self, width: int, height: int, count: int, classes: int, device: torch.device) -> None:
        self.size, self.device = (width, height), device
        scene = room(width, height, count, classes)
        projected = project_map(scene.means, scene.radii, POSE, scene.intrinsics)
        tensors = (*projected, scene.opacities, scene.colors)
        self.inputs = [x.detach().to(device).contiguous().requires_grad_() for x in tensors]
        self.features = torch.cat([scene.colors, scene.logits], 1).to(device)
        shapes = [(height, width, 3), *[(height, width)] * 3]
        self.upstream = [torch.randn(shape, device=device) for shape in shapes]

    @torch.no_grad()
    def forward(self, backend: str) -> None:
        composite(*self.inputs[:-1], self.features, *self.size, backend=BACKENDS.get(backend, backend))

    def forward_backward(self, backend: str) -> None:
        for tensor in self.inputs:
            tensor.grad = None
        image = composite(*self.inputs, *self.size, backend=BACKENDS.get(backend, backend))
        images = (image.features, image.depth_sum, image.depth_silhouette, image.silhouette)
        torch.autograd.backward(images, self.upstream)

    def forward_backward_of_all(self, backend: str) -> None:
        """Colours and classes, as a mapping needs it that learns the classes."""
        features = self.features.clone().requires_grad_()
        image = composite(*self.inputs[:-1], features, *self.size, backend=BACKENDS.get(backend, backend))
        torch.autograd.backward((image.features, image.depth_sum), (torch.ones_like(image.features), self.upstream[1]))

    def gsplat(self) -> Callable[[], None] | None:
        """The same Gaussians through gsplat's rasteriser (colours and depth), where it is installed."""
        try:
            from gsplat import rasterization
        except ImportError:
            return None
        u, v, sigma, z, opacity, features = (x.detach() for x in self.inputs)
        width, height = self.size
        f = 0.9 * width
        k = torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]], device=self.device)
        means = torch.stack([(u - width / 2) / f * z, (v - height / 2) / f * z, z], 1).requires_grad_()
        scales = (sigma * z / f)[:, None].repeat(1, 3).requires_grad_()
        quaternions = torch.tensor([1.0, 0, 0, 0], device=self.device).repeat(len(u), 1)
        leaves = [means, scales, opacity.requires_grad_(), features.requires_grad_()]
        view, upstream = (
            torch.eye(4, device=self.device)[None],
            torch.cat([*self.upstream[:1], self.upstream[1][..., None]], -1),
        )

        def run() -> None:
            for leaf in leaves:
                leaf.grad = None
            image, _, _ = rasterization(
                means,
                quaternions,
                scales,
                leaves[2],
                leaves[3],
                view,
                k[None],
                width,
                height,
                render_mode="RGB+D",
                eps2d=0.0,
            )
            image[0].backward(upstream)

        return run


def measure(row: tuple[int, int, int, int], backends: list[str], repeats: int, device: torch.device) -> list[dict]:
    """Median times of each backend, in turns, after one warm-up; gsplat beside them on CUDA."""
    case = Case(*row, device)
    tasks = {name: (lambda b=name: case.forward(b), lambda b=name: case.forward_backward(b)) for name in backends}
    if device.type == "cuda" and (run := case.gsplat()) is not None:
        tasks["gsplat"] = (lambda: None, run)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in tasks}
    for repeat in range(repeats + 1):
        for name, (forward, both) in tasks.items():
            pair = (timed(forward, device), timed(both, device))
            if repeat:
                times[name].append(pair)
    keys = dict(zip(("width", "height", "gaussians", "classes"), row, strict=True))
    return [
        {**keys, "backend": name, "forward_ms": statistics.median(p[0] for p in pairs),
         "forward_backward_ms": statistics.median(p[1] for p in pairs)}
        for name, pairs in times.items()
    ]  # fmt: skip


def print_table(results: list[dict]) -> None:
    print(
        f"{'image':>9} {'Gaussians':>9} {'classes':>7} {'backend':>10} "
        f"{'forward':>9} {'f + b':>9} {'ratio':>6} {'wanted':>6}"
    )
    by_row: dict[tuple, dict[str, dict]] = {}
    for result in results:
        key = tuple(result[k] for k in ("width", "height", "gaussians", "classes"))
        by_row.setdefault(key, {})[result["backend"]] = result
    for key, found in by_row.items():
        for name, result in found.items():
            both = result["forward_backward_ms"]
            ratio = f"{found['reference']['forward_backward_ms'] / both:.1f}" if "reference" in found else "-"
            wanted = WANTED[ROWS.index(key)] if key in ROWS and name == "cpu" else "-"
            print(f"{key[0]:>5}x{key[1]} {key[2]:>9} {key[3]:>7} {name:>10} {result['forward_ms']:>6.1f} ms "
                  f"{both:>6.1f} ms {ratio:>6} {wanted:>6}")  # fmt: skip


class Iteration:
    """A mapping iteration: projection, rendering, colour + SSIM + depth, fused Adam."""

    def __init__(self, row: tuple[int, int, int, int], device: torch.device) -> None:
        scene = room(*row)
        self.intrinsics, self.size = scene.intrinsics, row[:2]
        raw = (scene.means, scene.radii.log(), torch.logit(scene.opacities), scene.colors)
        self.parameters = [x.to(device).clone().requires_grad_() for x in raw]
        self.optimizer = torch.optim.Adam(self.parameters, lr=1e-4, fused=True)
        with torch.no_grad():
            seen = self.draw(torch.eye(4, dtype=torch.float64))
        self.image, self.depth = (255 * seen.features).to(torch.uint8), seen.depth
        self.exposure = torch.zeros(2, 3, device=device)
        self.weight = torch.ones_like(self.depth)

    def draw(self, pose: Tensor) -> Rendering:
        means, log_radii, opacity_logits, colors = self.parameters
        return render(means, log_radii.exp(), opacity_logits.sigmoid(), colors, pose, self.intrinsics)

    def step(self) -> None:
        self.optimizer.zero_grad()
        seen = self.draw(POSE)
        loss = photo_loss(seen.features, self.exposure, self.image)
        loss = loss + losses.depth_loss(seen.depth, self.depth, self.weight, 1.0)
        loss.backward()
        self.optimizer.step()


def measure_iteration(repeats: int, device: torch.device) -> None:
    case, iteration = Case(*ROWS[0], device), Iteration(ROWS[0], device)
    backend = choose_backend(None, case.inputs[0]).__name__.rpartition(".")[2]
    pairs = [
        (timed(lambda: case.forward_backward(backend), device), timed(iteration.step, device))
        for _ in range(repeats + 2)
    ][2:]
    bare, whole = (statistics.median(x) for x in zip(*pairs, strict=True))
    print(
        f"mapping iteration 320x240, 50 000: {whole:.1f} ms = {whole / bare:.2f} x bare forward + backward "
        "(wanted <= 3)"
    )
    learnt = statistics.median(timed(lambda: case.forward_backward_of_all(backend), device) for _ in range(repeats))
    print(f"forward + backward of colours and {ROWS[0][3]} classes: {learnt / bare:.2f} x that of colours")


def measure_pose(repeats: int) -> None:
    scene = room(320, 240, 50_000, 1)
    gaussians = (scene.means, scene.radii, scene.opacities, scene.colors)

    def gradient() -> Tensor:
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        seen = render(*gaussians, POSE, scene.intrinsics, twist)
        return torch.autograd.grad(seen.features.mean() + seen.depth.mean() + seen.silhouette.mean(), twist)[0]

    times = [timed(gradient, torch.device("cpu")) for _ in range(repeats + 1)]
    print(f"gradient of a pose by colour, depth and silhouette: {statistics.median(times[1:]):.1f} ms")


def measure_memory() -> None:
    """In this process: run alone. Peak beyond parameters, their gradients and Adam's state."""
    iteration = Iteration(ROWS[3], torch.device("cpu"))
    tensors = sum(x.numel() * x.element_size() for x in iteration.parameters)
    # A small step first: code, thread pools and libraries are no cost of the size.
    Iteration((32, 24, 100, 40), torch.device("cpu")).step()
    before = _resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    iteration.step()
    peak = _resident("VmHWM") - before
    own = 3 * tensors  # gradients and two moments come to life in the first step
    print(f"640x480, 200 000: peak {peak / 1e9:.2f} GB above the parameters in the first step, "
          f"{own / 1e9:.2f} GB of it gradients and Adam (wanted <= 1 GB)")  # fmt: skip


def _resident(key: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key):
            return 1024.0 * int(line.split()[1])
    raise RuntimeError(f"no {key} in /proc/self/status")


FIRST_USE = """
import sys, time; sys.path[:0] = {paths}
import torch
from render_scenes import random_gaussians
from msgs_slam.pipelines.render.api import composite
scene = {{k: x.requires_grad_() for k, x in random_gaussians(100, 40, 30, 3, 0).items()}}
start = time.perf_counter(), time.process_time()
composite(**scene, width=40, height=30).features.sum().backward()
print(time.perf_counter() - start[0], time.process_time() - start[1])
"""


def measure_first_use() -> None:
    """Seconds until the first gradients: with an empty cache, and again."""
    code = FIRST_USE.format(paths=sys.path[:2])
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        found = [
            subprocess.run(
                [sys.executable, "-c", code], env=environment, capture_output=True, check=True
            ).stdout.split()
            for _ in range(2)
        ]
    (wall, cpu), (later, _) = ([float(x) for x in pair] for pair in found)
    print(f"first forward + backward: {wall:.1f} s ({cpu:.1f} s of CPU) with an empty cache (wanted <= 5), "
          f"{later:.2f} s afterwards")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the table's rows to this file")
    parser.add_argument("--rows", default="0,1,2,3", help="which rows of the table, e.g. 0,3")
    parser.add_argument("--backends", help="comma-separated; the fastest and the reference by default")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=0, help="0: one per CPU")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    for name in ("iteration", "pose", "memory", "first-use"):
        parser.add_argument(f"--{name}", action="store_true", help="measure this instead of the table")
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    set_threads(arguments.threads)
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    others = [
        (arguments.iteration, lambda: measure_iteration(arguments.repeats, device)),
        (arguments.pose, lambda: measure_pose(arguments.repeats)),
        (arguments.memory, measure_memory),
        (arguments.first_use, measure_first_use),
    ]
    if any(wanted for wanted, _ in others):
        for wanted, task in others:
            if wanted:
                task()
        return
    card = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{torch.get_num_threads()} CPU threads"
    print(f"{card}, torch {torch.__version__}, median of {arguments.repeats}")
    backends = arguments.backends.split(",") if arguments.backends else [device.type, "reference"]
    rows = [ROWS[int(i)] for i in arguments.rows.split(",")]
    results = [result for row in rows for result in measure(row, backends, arguments.repeats, device)]
    print_table(results)
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
