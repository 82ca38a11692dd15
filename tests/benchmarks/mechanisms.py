"""What each mechanism of structure from motion is worth: where it acts, and the poses with it switched off.

    python tests/benchmarks/mechanisms.py --keep DIR                        all recordings, features and matches kept
    python tests/benchmarks/mechanisms.py --keep DIR kitchen house_portrait [--only unfolding readout]

Each recording is mapped once with everything, then once more without each mechanism that acted (the others change
nothing there). Features and matches are made once and shared. ATE in centimetres over placed keyframes; seconds of CPU.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np
from poses import compare, recordings
from tracking import Case, in_process, original_names, prepare

from msgs_slam.formats.colmap import pose_of
from msgs_slam.pipelines.frames import tasks
from msgs_slam.pipelines.frames.stage import FramesStage
from msgs_slam.pipelines.geometry.camera import ONE_CAMERA
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.sfm import candidates
from msgs_slam.pipelines.sfm import driver as sfm
from msgs_slam.pipelines.sfm.snapshots import Snapshots
from msgs_slam.pipelines.system.progress import SilentProgress

SMALL = ("replica", "kitchen", "whiteroom", "fr1_rpy", "house_portrait", "corridor", "office_loop", "bedroom")


@dataclass(frozen=True)
class Mechanism:
    """`owner.name` is what does it; off(arguments) is what it returns where it is switched off; acted(result,
    arguments): whether it did anything."""

    owner: Any
    name: str
    off: Callable[..., Any]
    acted: Callable[[Any, tuple[Any, ...]], bool]


def _same(position: int) -> Callable[..., Any]:
    return lambda *arguments: arguments[position]


_MAP = candidates.CandidateModels._map


def _first_mapper(self: Any, views: Any, pairs: Any, names: tuple[str, ...] = ("global",)) -> Any:
    return _MAP(self, views, pairs, names[:1])


MECHANISMS = {
    "second mapper": Mechanism(
        candidates.CandidateModels, "_map", _first_mapper,
        lambda found, _: found is not None and not found[1].startswith("global"),
    ),
    "bridges": Mechanism(sfm, "weakly_connected", lambda *_: [], lambda weak, _: bool(weak)),
    "unfolding": Mechanism(
        candidates.CandidateModels, "_remap_from_neighbours", lambda *_: None, lambda found, _: found is not None
    ),
    "growing": Mechanism(candidates.CandidateModels, "_register_remaining", _same(1), lambda out, a: out is not a[1]),
    "readout": Mechanism(candidates, "adjust_rolling", lambda *_: None, lambda out, _: out is not None),
    "freeing": Mechanism(
        candidates.CandidateModels, "_self_calibrate", lambda *_: None, lambda found, _: found is not None
    ),
    "pieces": Mechanism(sfm.StructureFromMotion, "_pieces", lambda *_: [], lambda found, _: bool(found)),
}  # fmt: skip


@contextmanager
def watched(acting: set[str]) -> Iterator[None]:
    """Collect the names of the mechanisms that act in this block."""
    with ExitStack() as stack:
        for name, m in MECHANISMS.items():
            original = getattr(m.owner, m.name)

            def spy(*arguments: Any, _of: Any = original, _m: Mechanism = m, _name: str = name, **more: Any) -> Any:
                result = _of(*arguments, **more)
                if _m.acted(result, arguments):
                    acting.add(_name)
                return result

            stack.enter_context(patch.object(m.owner, m.name, spy))
        yield


def begun(case: Case, source: Path, folder: Path) -> tuple[sfm.StructureFromMotion, list[Any], list[int]]:
    """Structure from motion of a source, its frames and keyframes; pictures, features and matches stay in `folder`."""
    config = load_config(overrides=["run.threads=1", *case.settings])
    context = StageContext(RunFolder(folder / "no.msgs"), source, config, folder, SilentProgress())
    stage = FramesStage(context)
    stage.open()
    stage.pick()
    keyframes, is_timed = stage.keyframes_by_parallax(), stage.recording.is_timed()
    given = (context, stage.camera, stage.origin, stage.frames, stage.masks, ONE_CAMERA, None, is_timed)
    return tasks.structure_from_motion(*given), stage.frames, keyframes


def measured(name: str, form: str, off: str, work: Path) -> dict[str, Any]:
    """One row, in a process of its own, without the mechanism `off` ("" for none)."""
    case = recordings(work)[name][form]
    source, folder = prepare(name, case, work), work / f"{name}_{form}"
    folder.mkdir(exist_ok=True)
    structure, frames, keyframes = begun(case, source, folder)
    structure.pairs_of(features := structure.features_of(keyframes), structure._proposed(features, _words(features)))
    apart = folder / "without" / (off.replace(" ", "_") or "nothing")
    apart.mkdir(parents=True, exist_ok=True)
    for shared in ("features", "pairs"):
        if not (apart / shared).exists():
            (apart / shared).symlink_to((structure.snapshots.folder / shared).resolve())
    acting: set[str] = set()
    started = time.process_time()
    m = MECHANISMS.get(off)
    with patch.object(m.owner, m.name, m.off) if m else watched(acting):
        found = replace(structure, snapshots=Snapshots(apart)).run(keyframes)
    ids = sorted(found.model.reg_image_ids())
    poses = np.array([pose_of(found.model.images[i]) for i in ids])
    originals = original_names(source, frames) if form != "set" else [""] * len(frames)
    chosen = [frames[keyframes[i - 1]] for i in ids]
    truth = [case.truth(originals[f.id], f.source_index) for f in chosen]
    r, seconds = found.report, time.process_time() - started
    return {
        "acting": sorted(acting), "placed": r.registered, "of": r.total, "part": len(r.components[0]),
        "mapper": found.mapper, "agreeing": r.pairs_agreeing, "seconds": seconds, **compare(poses, truth),
        "pieces": [p.num_reg_images() for p in found.pieces],
    }  # fmt: skip


def _words(features: Any) -> Any:
    from msgs_slam.pipelines.sfm.features import learn_vocabulary

    return learn_vocabulary(features, 0)


def print_row(name: str, off: str, row: dict[str, Any]) -> None:
    """One line."""
    if "failed" in row:
        print(f"{name:16} {off:18} {row['failed'][:100]}", flush=True)
        return
    size = f"{row['placed']:>4}/{row['of']} {row['part']:>4} {row.get('ate_cm', '-')!s:>8}"
    more = f"{row['mapper']} {row['pieces'] or ''} {', '.join(row['acting'])}"
    print(f"{name:16} {off or '(nothing)':18} {size} {row['agreeing']:.3f} {row['seconds']:6.0f}  {more}", flush=True)


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", metavar="RECORDING[:FORM]")
    parser.add_argument("--keep", type=Path, required=True, help="folder for features and matches")
    parser.add_argument("--only", nargs="*", choices=MECHANISMS, help="these, whether they act or not")
    arguments = parser.parse_args()
    work = arguments.keep.resolve()
    work.mkdir(exist_ok=True)
    print(f"{'recording':16} {'without':18} placed part  ATE cm  agree  CPU s  mapper, pieces, what acts")
    for wanted in arguments.recordings or SMALL:
        name, _, form = wanted.partition(":")
        form = form or next(iter(recordings(work)[name]))
        whole = in_process(measured, name, form, "", work)
        print_row(name, "", whole)
        for off in arguments.only or whole.get("acting", []):
            print_row(name, off, in_process(measured, name, form, off, work))


if __name__ == "__main__":
    main()
