"""What each term of the method earns: the same run with one switched off, measured over seeds.

    python tests/benchmarks/ablate.py SOURCE --truth DATASET [--seeds 0,1,2] [--only NAME] [--set section.key=value]

Stopped at any moment, the same command goes on where it was.
"""

import argparse
import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

from msgs_slam.formats.atomic import write_text
from msgs_slam.formats.datasets import Dataset, open_sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.textfile import read_json_object, write_json
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.evaluation.evaluate import evaluate_outcome
from msgs_slam.pipelines.reconstruct import all_stages, reconstruct
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import Manifest, write_manifest
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.reads import Reads, StageRecord
from msgs_slam.pipelines.run.settings import config_to_toml, load_config
from msgs_slam.pipelines.run.stages import Stage
from msgs_slam.pipelines.system.progress import Progress, SilentProgress

COMPLETE = "complete"
ABLATIONS: dict[str, tuple[str, ...]] = {
    COMPLETE: (),
    "without depth loss": ("mapping.depth_weight=0.0",),
    "without pose refinement": ("mapping.refine_poses=false",),
}
"""Name → what differs from the complete method. The paper's own terms are taken away one by one in `paper.py`."""

_LAST = "global_ba"
_SHARED = ("frames", "proxy")
_NOTES = (
    "Frames and proxies are the same in all runs, made once with the first seed; from tracking on, every seed is a run "
    "of its own, and every row from the first stage that it changes.",
    "Cells are means ± standard deviations over the seeds (of one seed: the figure).",
    "Errors and qualities as in `msgs-slam evaluate`; images at keyframes, and where frames are held out at refined "
    "own poses.",
)


@dataclass(frozen=True)
class Job:
    """One row of the table with one seed."""

    variant: str
    seed: int
    run: RunFolder
    base: RunFolder
    config: Config


def ablate(
    source: Path,
    truth: Dataset,
    folder: Path,
    config: Config,
    seeds: tuple[int, ...],
    progress: Progress,
    variants: tuple[str, ...] = tuple(ABLATIONS),
    max_views: int = 40,
) -> dict[str, Any]:
    """Reconstruct and evaluate `source` once a variant and seed; returns what `ablation.json` in `folder` holds then.

    Runs lie in folder/runs, and what is finished there is not done again: a call that was killed goes on. The table in
    ablation.md and the figures in ablation.json are brought up to date after every run. Raises InputError for an
    unknown variant, seeds that are none or occur twice, a folder that holds another ablation, and as `reconstruct` and
    `evaluate_outcome` do.
    """
    _require(variants, seeds)
    jobs = list(_jobs(folder, config, seeds, variants))
    _claim(folder, source, truth, config)
    result: dict[str, Any] = {}
    for n, job in enumerate(progress.track(jobs, "ablation", len(jobs)), 1):
        _bring_up_to_date(source, job, jobs[0], progress)
        _measure(job, truth, progress, max_views)
        done = [j for j in jobs[:n] if j.variant in variants]
        result = _collected(source, truth, config, seeds, done)
        write_json(folder / "ablation.json", result)
        write_text(folder / "ablation.md", ablation_table(result))
    return result


def _require(variants: tuple[str, ...], seeds: tuple[int, ...]) -> None:
    unknown = [v for v in variants if v not in ABLATIONS]
    if unknown or not variants:
        raise InputError(f"no ablation {', '.join(unknown) or 'was named'}; known: {', '.join(ABLATIONS)}")
    if not seeds or len(set(seeds)) != len(seeds):
        raise InputError(
            f"seeds must be different numbers, for example 0,1,2; got {','.join(map(str, seeds)) or 'none'}"
        )


def _claim(folder: Path, source: Path, truth: Dataset, config: Config) -> None:
    """Refuse a folder of another ablation: its finished runs would stand in the same table."""
    stamp = {
        "source": str(source.resolve()),
        "truth": str(truth.root.resolve()),
        "settings": config_to_toml(replace(config, run=replace(config.run, seed=0))),
    }
    file = folder / "origin.json"
    if file.exists():
        before = read_json_object(file)
        other = [k for k in stamp if before.get(k) != stamp[k]]
        if other:
            raise InputError(
                f"{folder} holds an ablation with another {' and another '.join(other)}. Choose another folder with "
                "--out, or delete it"
            )
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} exists and is not an ablation's folder. Choose another with --out")
    write_json(file, stamp)


def _jobs(folder: Path, config: Config, seeds: tuple[int, ...], variants: tuple[str, ...]) -> Iterator[Job]:
    """The complete run of a seed comes first: the others branch off it."""
    for seed in seeds:
        seeded = replace(config, run=replace(config.run, seed=seed))
        base = RunFolder(folder / "runs" / f"{_slug(COMPLETE)}_seed{seed}.msgs")
        for name in dict.fromkeys((COMPLETE, *variants)):
            run = RunFolder(folder / "runs" / f"{_slug(name)}_seed{seed}.msgs")
            yield Job(name, seed, run, base, load_config(None, ABLATIONS[name], base=seeded))


def _slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower())


def _bring_up_to_date(source: Path, job: Job, first: Job, progress: Progress) -> None:
    if job.variant != COMPLETE:
        branch(job.base, job.run, (*_SHARED, "tracking", "mapping", _LAST))
    elif job.run != first.run:
        branch(first.run, job.run, _SHARED, (all_stages(job.config.run.method), job.config))
    reconstruct(source, job.run, job.config, progress, until=_LAST)


def _measure(job: Job, truth: Dataset, progress: Progress, max_views: int) -> None:
    """Write the figures of a run beside it, unless they are those of what it holds now."""
    file = _figures_file(job)
    stamp = {name: record.content for name, record in job.run.records.items()} | {"views": max_views}
    if file.exists() and read_json_object(file).get("stamp") == stamp:
        return
    write_json(file, {"stamp": stamp, "figures": evaluate_outcome(load_outcome(job.run), truth, progress, max_views)})


def _figures_file(job: Job) -> Path:
    return job.run.root.with_suffix(".json")


METRICS: dict[str, tuple[tuple[str, ...], float, str]] = {
    "ATE Sim(3), cm": (("trajectory", "sim3 all", "rmse"), 100, "not measured"),
    "ATE SE(3), cm": (("trajectory", "se3 all", "rmse"), 100, "not measured"),
    "PSNR, dB": (("images", "keyframes", "psnr"), 1, "not measured"),
    "SSIM": (("images", "keyframes", "ssim"), 1, "not measured"),
    "LPIPS": (("images", "keyframes", "lpips"), 1, "not measured"),
    "held-out PSNR, dB": (("images", "held out at refined poses", "psnr"), 1, "no frame was held out: --hold-out 8"),
    "depth L1, cm": (("depth", "metric_l1"), 100, "not measured"),
    "depth L1 after one scale, cm": (("depth", "scaled_l1"), 100, "not measured"),
    "mIoU, %": (("labels", "mean_iou"), 100, "not measured"),
    "clustering mIoU, %": (
        ("labels", "clustering", "one to one", "mean_iou"),
        100,
        "the classes have the truth's names",
    ),
    "Gaussians": (("cost", "gaussians"), 1, "no map"),
}
"""Column → where `evaluate_outcome` has it, the factor to its unit, and why it is missing, where nothing else says so.
"""


def _collected(source: Path, truth: Dataset, config: Config, seeds: tuple[int, ...], jobs: list[Job]) -> dict[str, Any]:
    rows = []
    missing: dict[str, str] = {}
    for name in dict.fromkeys(j.variant for j in jobs):
        runs = [read_json_object(_figures_file(j))["figures"] for j in jobs if j.variant == name]
        values = {column: [_value(r, *METRICS[column], column, missing) for r in runs] for column in METRICS}
        known = {c: [v for v in vs if v is not None] for c, vs in values.items()}
        rows.append(
            {
                "name": name,
                "settings": list(ABLATIONS[name]),
                "seeds": [j.seed for j in jobs if j.variant == name],
                "mean": {c: float(np.mean(v)) for c, v in known.items() if v},
                "sd": {c: float(np.std(v, ddof=1)) for c, v in known.items() if len(v) > 1},
                "values": values,
            }
        )
    return {
        "source": str(source),
        "truth": f"{truth.root.name} ({truth.format})",
        "seeds": list(seeds),
        "hold_out": config.mapping.hold_out,
        "notes": list(_NOTES),
        "missing": missing,
        "rows": rows,
    }


def _value(
    figures: dict[str, Any], path: tuple[str, ...], factor: float, reason: str, column: str, missing: dict[str, str]
) -> float | None:
    """The figure in its unit; None with the reason in `missing`."""
    at: Any = figures
    for key in path:
        if isinstance(at, dict) and key not in at:
            missing.setdefault(column, str(at.get("missing", reason)))
            return None
        at = at[key]
    if isinstance(at, dict) or at is None:
        missing.setdefault(column, at["missing"] if at else "every image is equal to its frame")
        return None
    return factor * float(at)


def ablation_table(result: dict[str, Any]) -> str:
    """The protocol, a row a variant, then what could not be measured and what each row switches."""
    rows = result["rows"]
    columns = list(dict.fromkeys(c for row in rows for c in row["mean"]))
    lines = [f"# Ablations of {result['source']} against {result['truth']}", ""]
    lines += [f"- {note}" for note in result["notes"]]
    lines += ["", "| | " + " | ".join(["seeds", *columns]) + " |", "| --- " * (len(columns) + 2) + "|"]
    for row in rows:
        cells = [_cell(row, column) for column in columns]
        lines.append(f"| {row['name']} | {', '.join(map(str, row['seeds']))} | " + " | ".join(cells) + " |")
    lines += ["", *(f"- {c}: – ({why})" for c, why in result["missing"].items() if c not in columns)]
    lines += [f"- {row['name']}: {', '.join(row['settings']) or 'all terms'}" for row in rows]
    return "\n".join(lines) + "\n"


def _cell(row: dict[str, Any], column: str) -> str:
    if column not in row["mean"]:
        return "–"
    mean, sd = row["mean"][column], row["sd"].get(column)
    digits = 0 if column == "Gaussians" else 4 if column in ("SSIM", "LPIPS") else 2
    return f"{mean:.{digits}f}" + ("" if sd is None else f" ± {sd:.{digits}f}")


def branch(
    origin: RunFolder, target: RunFolder, names: Iterable[str], accept: tuple[list[Stage], Config] | None = None
) -> None:
    """Make `target` with these stages of `origin`, as hard links where the disk allows it, and its settings.

    With accept = (all stages, settings) the taken stages count as made with those settings and that seed, which they
    may not have had: for comparisons that vary what comes after them, such as over seeds from one set of proxies. The
    target is there whole or not at all; where it is there already, nothing happens. Raises InputError for a damaged
    manifest of `origin`.
    """
    if target.manifest_file.exists():
        return
    unfinished = RunFolder(target.root.with_name(target.root.name + ".partial"))
    shutil.rmtree(unfinished.root, ignore_errors=True)
    unfinished.root.mkdir(parents=True)
    source, records = origin.source, origin.records
    taken = {name: records[name] for name in names if name in records}
    for name in taken:
        shutil.copytree(origin.stage(name), unfinished.stage(name), copy_function=_link)
    config = origin.settings()
    if accept is not None:
        taken, config = _accepted(taken, *accept, source.digest), accept[1]
    write_manifest(unfinished.manifest_file, Manifest(source, taken))
    unfinished.save_settings(config)
    os.replace(unfinished.root, target.root)


def _accepted(
    records: dict[str, StageRecord], stages: list[Stage], config: Config, source: str
) -> dict[str, StageRecord]:
    accepted = {}
    for stage in stages:
        if (record := records.get(stage.name)) is None:
            break
        accepted[stage.name] = replace(record, reads=Reads(stage.program, source))
    return accepted


def _link(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
    return str(Path(target))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--truth", type=Path, required=True, help="a data set with true poses")
    parser.add_argument("--out", type=Path, help="default: the source's name + .ablation, here")
    parser.add_argument("--seeds", default="0", help="one run of every row with each seed")
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help=", ".join(ABLATIONS))
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of all rows")
    arguments = parser.parse_args()
    config = load_config(overrides=["mapping.hold_out=8", *arguments.set])
    result = ablate(
        arguments.source,
        open_sequence(arguments.truth),
        arguments.out or Path(arguments.source.stem + ".ablation"),
        config,
        tuple(map(int, arguments.seeds.split(","))),
        SilentProgress(),
        tuple(arguments.only) or tuple(ABLATIONS),
    )
    print(ablation_table(result))


if __name__ == "__main__":
    main()
