"""Measures camera poses on real and made-up sequences, beside pycolmap's two mappers on the same pictures.

    python tests/benchmarks/tracking.py                              all sequences, the table
    python tests/benchmarks/tracking.py kitchen whiteroom_files      some of them
    python tests/benchmarks/tracking.py --set frames.overlap=4 --json rows.json
    python tests/benchmarks/tracking.py --colmap                     pycolmap's mappers too, self-calibrated
    python tests/benchmarks/tracking.py --until mapping              poses as the map has refined them
    python tests/benchmarks/tracking.py --lengths 250 500 1000       a walk of that many frames in the made-up room

ATE is the RMSE of camera centres in centimetres after Sim(3), or SE(3) where the depth is metric; `worst` is the camera
farthest off after Sim(3). Seconds are seconds of CPU over all threads, which other work on the machine changes little;
the rows of --json hold those of the clock too. Every row runs in a process of its own, whose peak memory is the row's.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import multiprocessing
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgs_slam.pipelines.run.files import FIGURES, FRAMES, TRAJECTORY

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np
from hard_sequences import HARD, write_hard, write_noisy_depth
from numpy.typing import NDArray
from parted_sequences import LONG, PARTED, kitchen_two_row, write_parted
from PIL import Image

DATA = ROOT.parent / "shared" / "data"
PLAIN = ("run.format=images",)
"""Pictures named like a data set's, but without what that says of their camera."""
WALKS: dict[str, dict[str, Any]] = {
    "corridor": {"frames": 150, "laps": 1.08},
    "classroom": {
        "texel": 0.005,
        "frames": 100,
        "laps": 0.33,
        "width": 640,
        "height": 480,
        "noise": 1.5,
        "shutter": 0.3,
    },
}
"""Layouts of the made-up world, and how a camera walks through each."""
COARSE = ("proxy.stereo_side=160",)
"""Quick proxies where only poses are judged: multi-view depth takes no part in them."""
Truth = Callable[[str, int], NDArray[np.float64] | None]
"""(name in the source, index in the source) -> world_from_cam (4, 4), None where it is not known."""


@dataclass(frozen=True)
class Case:
    """A source, the settings it is run with, and its truth."""

    source: Path
    settings: tuple[str, ...]
    truth: Truth
    glob: str = "*"
    last: int = 0
    rate: float = 0.0
    """Images a second, of which a video is made; 0 for none."""


def rows_of(path: Path) -> NDArray[np.float64]:
    """(N, 4, 4) from lines of sixteen numbers."""
    return np.loadtxt(path).reshape(-1, 4, 4)


def by_number(poses: NDArray[np.float64], step: int = 1) -> Truth:
    """The number in the name (or the index, for a video) over `step` is the row."""

    def look_up(name: str, index: int) -> NDArray[np.float64] | None:
        digits = "".join(c for c in Path(name).stem if c.isdigit()) if name else str(index)
        row = int(digits) // step
        return poses[row] if row < len(poses) else None

    return look_up


def written_truth(path: Path) -> Truth:
    """Rows of a file that is written only when its sequence is."""
    return lambda name, index: rows_of(path)[int(Path(name).stem)]


def kitchen_truth(name: str, index: int) -> NDArray[np.float64] | None:
    """Its folder holds the poses of even frames only."""
    number = int(name.split(".")[0][-6:]) if name else index
    path = DATA / "kitchen" / f"frame-{number:06d}.pose.txt"
    return np.loadtxt(path) if path.exists() else None


def phone_truth(name: str, index: int) -> NDArray[np.float64]:
    """Its pictures count from one."""
    return rows_of(DATA / "phone_desk/poses_c2w.txt")[int(Path(name).stem[-4:]) - 1]


def of_set(folder: Path) -> Truth:
    """The truth that a data set brings along, by the picture's name, or by its number where that is not given."""

    def look_up(name: str, index: int) -> NDArray[np.float64] | None:
        from msgs_slam.formats.datasets import open_sequence, recognise_source

        if folder not in _OPENED:
            sequence = open_sequence(folder, recognise_source(folder) or "folder")
            poses = sequence.world_from_cam
            assert poses is not None
            _OPENED[folder] = dict(zip(sequence.names, poses, strict=True))
        pose = _OPENED[folder][name] if name else list(_OPENED[folder].values())[index]
        return pose if np.isfinite(pose).all() else None

    return look_up


_OPENED: dict[Path, dict[str, NDArray[np.float64]]] = {}


def cases(work: Path) -> dict[str, Case]:
    """All sequences by name. `work` takes what has to be written for them."""
    replica, white, phone = DATA / "replica_office0", DATA / "whiteroom", DATA / "phone_desk"
    office, room = by_number(rows_of(replica / "traj_derived_c2w.txt"), 10), by_number(rows_of(white / "traj.txt"))
    known = "frames.intrinsics=300,300,300,170"
    long = rows_of(DATA / "kitchen_long" / "world_from_camera_16.txt")
    files = f'proxy.depth="files:{white / "proxy_depth"}"'
    return {
        "kitchen_video": Case(DATA / "videos/kitchen_640x480_30fps.mp4", (), kitchen_truth),
        "kitchen": Case(DATA / "kitchen", PLAIN, kitchen_truth, "*.color.jpg"),
        "replica": Case(replica / "rgb", PLAIN, office),
        "replica_files": Case(replica / "rgb", (*PLAIN, known, f'proxy.depth="files:{work / "noisy"}"'), office),
        "phone_desk": Case(phone / "images", PLAIN, phone_truth, last=60),
        "phone_desk_jump": Case(phone / "images", PLAIN, phone_truth),
        "whiteroom_video": Case(white / "video.mp4", (), room),
        "whiteroom_files": Case(white / "rgb", (*PLAIN, files), room),
        "fr1_rpy": Case(DATA / "tum_fr1_rpy" / "rgb", (*PLAIN, *COARSE), of_set(DATA / "tum_fr1_rpy")),
        **{
            name: Case(work / name / "rgb", (*PLAIN, *COARSE), written_truth(work / name / "traj.txt"))
            for name in WALKS
        },
        "bedroom": Case(DATA / "videos/bedroom_848x364_58fps.mp4", (), lambda *_: None),
        "house_portrait": Case(DATA / "videos/house_portrait_540x960_30fps.mp4", (), lambda *_: None),
        "kitchen_long": Case(DATA / LONG, (), by_number(long)),
        "kitchen_7scenes": Case(work / "kitchen_7scenes", (), by_number(long)),
        "kitchen_two": Case(work / "kitchen_two" / "both.videos", (), lambda _, index: long[kitchen_two_row(index)]),
        "whiteroom_halves": Case(work / "whiteroom_halves" / "rgb", PLAIN, room),
        "whiteroom_apart": Case(work / "whiteroom_apart" / "rgb", PLAIN, room),
        "two_rooms": Case(work / "two_rooms" / "rgb", PLAIN, written_truth(work / "two_rooms" / "traj.txt")),
        **{
            name: Case(work / name / "rgb", (*PLAIN, *COARSE), written_truth(work / name / "traj.txt")) for name in HARD
        },
    }


def prepare(name: str, case: Case, work: Path) -> Path:
    """The source to reconstruct: written or cut where the case asks for it."""
    if name == "replica_files":
        write_noisy_depth(DATA / "replica_office0" / "depth", work / "noisy")
    if name in WALKS:
        return write_walk(work / name, name, **WALKS[name])
    if name in HARD:
        return write_hard(name, work / name, DATA)
    if name in PARTED:
        return write_parted(name, work / name, DATA)
    if case.rate:
        return write_video(work / f"{name}.mp4", case.source, case.rate)
    if case.glob == "*" and not case.last:
        return case.source
    folder = work / f"{name}_pictures"
    folder.mkdir(exist_ok=True)
    pictures = sorted(case.source.glob(case.glob))[: case.last or None]
    for picture in pictures:
        if not (folder / picture.name).exists():
            shutil.copy(picture, folder / picture.name)
    return folder


def write_video(path: Path, pictures: Path, rate: float) -> Path:
    """The pictures of a folder as an H.264 video of that rate."""
    from fractions import Fraction

    import av

    if not path.exists():
        partial = path.with_suffix(".partial.mp4")
        with av.open(str(partial), "w") as container:
            stream = container.add_stream("libx264", rate=Fraction(rate).limit_denominator(1000))
            stream.options = {"crf": "17", "preset": "fast", "threads": "1"}
            stream.pix_fmt = "yuv420p"
            images = [Image.open(p).convert("RGB") for p in sorted(pictures.iterdir())]
            stream.width, stream.height = images[0].size
            for image in images:
                container.mux(stream.encode(av.VideoFrame.from_image(image)))
            container.mux(stream.encode())
        partial.replace(path)
    return path


def write_walk(folder: Path, layout: str, texel: float = 0.006, **options: Any) -> Path:
    """A walk in the made-up world as a folder of pictures, with traj.txt beside it."""
    import tests.benchmarks.worlds  # noqa: F401 (more layouts)
    from tests.world.clip import ClipOptions, make_world
    from tests.world.write import write_sequence

    if not (folder / "traj.txt").exists():
        write_sequence(folder, make_world(layout, texel=texel), ClipOptions(**{"width": 480, "height": 360} | options))
    return folder / "rgb"


def measure_ours(name: str, work: Path, settings: Sequence[str], until: str) -> dict[str, Any]:
    """Run the stages and compare the trajectory with the truth."""
    from msgs_slam.pipelines.run.folder import RunFolder
    from msgs_slam.pipelines.run.settings import load_config

    case = walk_case(name, work) if name.startswith("walk_") else cases(work)[name]
    source = prepare(name, case, work)
    run = RunFolder(work / f"{name}.msgs")
    config = load_config(overrides=[*case.settings, *settings])
    with adjustment_timed() as adjusting:
        records, seconds = run_stages_timed(source, run, config, until)
    trajectory, frames = run.load(TRAJECTORY, until), run.load(FRAMES)
    pieces = {piece: run.load(TRAJECTORY, "tracking", piece=piece) for piece in run.pieces("tracking")}
    originals = original_names(source, frames)
    truth = [case.truth(n, f.source_index) for n, f in zip(originals, frames, strict=True)]
    metric = bool(run.load(FIGURES["proxy"]).get("metric", False))
    return {
        **errors(trajectory.cam_from_world, trajectory.is_posed, truth, metric),
        "pieces": {name: errors(t.cam_from_world, t.is_posed, truth, False) for name, t in pieces.items()},
        "cpu_seconds": {stage: round(spent["cpu"], 1) for stage, spent in seconds.items()},
        "clock_seconds": {stage: round(spent["clock"], 1) for stage, spent in seconds.items()},
        "adjustment_cpu_seconds": round(sum(adjusting), 1),
        "figures": {s: records[s].figures for s in ("frames", "tracking", "global_ba") if s in records},
        "warnings": [w for r in records.values() for w in r.warnings],
    }


def run_stages_timed(
    source: Path, run: Any, config: Any, until: str
) -> tuple[dict[str, Any], dict[str, dict[str, float]]]:
    """The stages' records, and what each took; of a stage that is up to date, what it took when it ran."""
    from msgs_slam.pipelines.config import STAGES
    from msgs_slam.pipelines.reconstruct import reconstruct
    from msgs_slam.pipelines.system.progress import SilentProgress

    stored = run.root.with_suffix(".seconds.json")
    seconds = json.loads(stored.read_text()) if stored.exists() else {}
    wanted = STAGES[: STAGES.index(until) + 1]
    for stage in wanted:
        before = run.records.get(stage)
        clock, cpu = time.monotonic(), time.process_time()
        records = reconstruct(source, run, config, SilentProgress(), stage)
        if records[stage] != before:
            seconds[stage] = {"clock": time.monotonic() - clock, "cpu": time.process_time() - cpu}
            stored.write_text(json.dumps(seconds))
    return records, {stage: seconds[stage] for stage in wanted}


@contextmanager
def adjustment_timed() -> Iterator[list[float]]:
    """CPU seconds of every adjustment of all keyframes together while this is open."""
    from msgs_slam.pipelines.sfm import candidates
    from msgs_slam.pipelines.tracking import stage

    spent: list[float] = []

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            began = time.process_time()
            try:
                return function(*arguments, **named)
            finally:
                spent.append(time.process_time() - began)

        return call

    plain = stage.adjust_state, candidates.adjust_model
    stage.adjust_state, candidates.adjust_model = timed(plain[0]), timed(plain[1])
    try:
        yield spent
    finally:
        stage.adjust_state, candidates.adjust_model = plain


def walk_case(name: str, work: Path) -> Case:
    """walk_N: the first N frames of a walk of four laps of 250 frames through the made-up room."""
    from tests.world.clip import ClipOptions, make_world, render_frame
    from tests.world.write import write_sequence

    count = int(name.removeprefix("walk_"))
    folder = work / name
    if not (folder / "traj.txt").exists():
        options = ClipOptions(frames=1000, width=320, height=240, laps=4.0)
        world = make_world("room", texel=0.006)
        write_sequence(folder, world, options, (render_frame(world, options, i) for i in range(count)))
    return Case(folder / "rgb", (*PLAIN, *COARSE), by_number(rows_of(folder / "traj.txt")))


def original_names(source: Path, frames: Sequence[Any]) -> list[str]:
    """Names of the frames' pictures in a folder; nothing for a video."""
    if source.is_file():
        return [""] * len(frames)
    from msgs_slam.formats.image_folder import list_images

    names = [p.name for p in list_images(source)]
    return [names[f.source_index] for f in frames]


def errors(
    cam_from_world: NDArray[np.float64],
    posed: NDArray[np.bool_],
    truth: Sequence[NDArray[np.float64] | None],
    metric: bool,
) -> dict[str, Any]:
    """Frames posed, ATE after Sim(3), after SE(3) where metric, scale error; centimetres and per cent."""
    from msgs_slam.pipelines.geometry.se3 import align_points

    out: dict[str, Any] = {"posed": int(posed.sum()), "frames": len(posed)}
    use = posed & np.array([t is not None for t in truth])
    if use.sum() < 3:
        return out
    centres = np.linalg.inv(cam_from_world[use])[:, :3, 3]
    wanted = np.array([t[:3, 3] for t, used in zip(truth, use, strict=True) if used and t is not None])
    for key, with_scale in (("sim3_cm", True), ("se3_cm", False)):
        if with_scale or metric:
            similarity = align_points(centres, wanted, with_scale)
            apart = similarity.apply(centres) - wanted
            out[key] = round(100 * float(np.sqrt((apart**2).sum(1).mean())), 3)
            if with_scale:
                out["worst_cm"] = round(100 * float(np.linalg.norm(apart, axis=1).max()), 3)
            if with_scale and metric:
                out["scale_error_percent"] = round(100 * (1 / similarity.scale - 1), 2)
    extent = float(np.linalg.norm(wanted.max(0) - wanted.min(0)))
    out["sim3_percent_of_extent"] = round(out["sim3_cm"] / extent, 3)
    return out


def measure_colmap(name: str, work: Path, mapper: str) -> dict[str, Any]:
    """pycolmap's mapper on the same pictures: see `with_colmap`."""
    case = cases(work)[name]
    run = work / f"{name}.msgs"
    poses, posed, truth, spent, _ = with_colmap(prepare(name, case, work), case, run, work / f"{name}_colmap", mapper)
    return {
        **errors(poses, posed, truth, False),
        "cpu_seconds": {mapper: round(spent[1], 1)},
        "clock_seconds": {mapper: round(spent[0], 1)},
    }


def with_colmap(
    source: Path, case: Case, run_folder: Path, place: Path, mapper: str
) -> tuple[NDArray[np.float64], NDArray[np.bool_], list[NDArray[np.float64] | None], tuple[float, float], Any]:
    """cam_from_world (N, 4, 4) and whether each is placed (N,), the truths, seconds of clock and CPU, and the model (or
    None), by pycolmap's mapper on the frames that a run has of a source; camera unknown, sequential matching with
    overlap 10.

    The second mapper takes the first one's features and matches; their time counts in both rows.
    """
    import pycolmap

    from msgs_slam.pipelines.run.folder import RunFolder

    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    run = RunFolder(run_folder)
    frames = run.load(FRAMES)
    folder = run.stage("frames") if source.is_file() else source
    names = [f.name for f in frames] if source.is_file() else original_names(source, frames)
    database, stored = place / "database.db", place / "seconds.json"
    if not stored.exists():
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        clock, cpu = time.monotonic(), time.process_time()
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
        pycolmap.extract_features(database, folder, names, pycolmap.CameraMode.SINGLE, reader_options=reader)
        pycolmap.match_sequential(database, pairing_options=pycolmap.SequentialPairingOptions(overlap=10))
        stored.write_text(json.dumps([time.monotonic() - clock, time.process_time() - cpu]))
    before = json.loads(stored.read_text())
    own = place / f"{mapper}.db"
    shutil.copy(database, own)
    clock, cpu = time.monotonic(), time.process_time()
    (place / mapper).mkdir(exist_ok=True)
    if mapper == "global":
        pycolmap.calibrate_view_graph(own)
        models = pycolmap.global_mapping(own, folder, place / mapper)
    else:
        models = pycolmap.incremental_mapping(own, folder, place / mapper)
    spent = time.monotonic() - clock + before[0], time.process_time() - cpu + before[1]
    poses, posed = np.tile(np.eye(4), (len(names), 1, 1)), np.zeros(len(names), bool)
    model = max(models.values(), key=lambda m: m.num_reg_images()) if models else None
    for image in model.images.values() if model is not None else ():
        poses[names.index(image.name), :3] = image.cam_from_world().matrix()
        posed[names.index(image.name)] = True
    truth = [case.truth("" if source.is_file() else n, f.source_index) for n, f in zip(names, frames, strict=True)]
    return poses, posed, truth, spent, model


def in_process(job: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """Run the job in a new process; adds its peak memory, or the reason of its failure."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(sender, job, arguments))
    process.start()
    sender.close()
    try:
        return receiver.recv()
    except EOFError:
        return {"failed": "the process died"}
    finally:
        process.join()


def _answer(sender: Any, job: Callable[..., dict[str, Any]], arguments: tuple[Any, ...]) -> None:
    from msgs_slam.formats.errors import InputError

    try:
        row = job(*arguments)
    except InputError as error:
        row = {"failed": str(error)}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    sender.send({**row, "peak_mb": round(peak)})


def print_row(name: str, method: str, row: dict[str, Any]) -> None:
    """One line of the table."""
    if "failed" in row:
        print(f"{name:18} {method:12} {row['failed']}", flush=True)
        return
    seconds = row["cpu_seconds"]
    poses = [v for k, v in seconds.items() if k in ("frames", "tracking", "global_ba", "global", "incremental")]
    own = [v for k, v in seconds.items() if k in ("tracking", "global_ba")]
    cells = [
        f"{row['posed']}/{row['frames']}",
        *(f"{row[k]:.3f}" if k in row else "-" for k in ("sim3_cm", "worst_cm", "se3_cm", "scale_error_percent")),
        f"{sum(poses):.0f}",
        f"{sum(own):.0f}" if own else "-",
        str(row["peak_mb"]),
        str(len(row["warnings"])) if "warnings" in row else "-",
    ]
    print(f"{name:18} {method:12}" + "".join(f"{c:>11}" for c in cells), flush=True)
    for piece, found in row.get("pieces", {}).items():
        print(f"{'':31} {piece}: {found['posed']} frames, {found.get('sim3_cm', '-')} cm")
    for warning in row.get("warnings", []):
        print(f"{'':31} {warning}", flush=True)


COLUMNS = ("posed", "Sim3 cm", "worst cm", "SE3 cm", "scale %", "s poses", "s trk+ba", "peak MB", "warnings")
HEADER = f"{'sequence':18} {'method':12}" + "".join(f"{h:>11}" for h in COLUMNS)


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--until", choices=("tracking", "mapping", "global_ba"), default="tracking")
    parser.add_argument("--colmap", action="store_true")
    parser.add_argument(
        "--mapper", action="append", choices=("incremental", "global"), help="of pycolmap's, this alone"
    )
    parser.add_argument("--lengths", nargs="*", type=int, default=[])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="folder for the runs, which a second call then takes up again")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = arguments.keep or Path(temporary)
        work.mkdir(exist_ok=True)
        names = [f"walk_{n}" for n in arguments.lengths] or arguments.sequences or list(cases(work))
        rows = []
        print(HEADER)
        for name in names:
            jobs: list[tuple[str, Callable[..., dict[str, Any]], tuple[Any, ...]]] = [
                ("ours", measure_ours, (name, work, arguments.set, arguments.until))
            ]
            if arguments.colmap and not name.startswith("walk_"):
                jobs += [(m, measure_colmap, (name, work, m)) for m in arguments.mapper or ("incremental", "global")]
            for method, job, args in jobs:
                row = in_process(job, *args)
                print_row(name, method, row)
                rows.append({"sequence": name, "method": method, **row})
        if arguments.json:
            arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
