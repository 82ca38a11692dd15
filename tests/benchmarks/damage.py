"""Every file of a finished run deleted, cut, with one bit flipped, replaced by another run's: what each command says.

    python tests/benchmarks/damage.py RUN OTHER_RUN --truth DATASET --work DIR [--series 2]

RUN and OTHER_RUN are finished runs of small clips, of different sources; of files that come in series (frames, proxy
maps) `--series` of each are taken. A command passes when it ends with code 1, names the file and says what to type, or
when it does not use the file: then what it writes, or `view` shows, must be the same bytes as for the whole run.
`status` must name the file, `view` may, beside a frame that is damaged, and the report where it lists the exported
files. At the end one file of each stage is damaged and `resume` must bring back the same bytes. Prints the counts; exit
code 1 if any is wrong.
"""

import argparse
import collections
import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import click
from click.testing import CliRunner, Result

from msgs_slam.formats.reading import file_sha256
from msgs_slam.msgs_cli.main import main as msgs_slam
from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.evaluation.serve import PageServer
from msgs_slam.pipelines.run.folder import RunFolder

Damage = Callable[[Path, Path], None]


def delete(path: Path, other: Path) -> None:
    """Gone."""
    path.unlink()


def cut(path: Path, other: Path) -> None:
    """Its first half."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path: Path, other: Path) -> None:
    """One bit in its middle."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def replace(path: Path, other: Path) -> None:
    """The other run's file of that name."""
    shutil.copyfile(other, path)


DAMAGES: tuple[Damage, ...] = (delete, cut, flip, replace)


def commands(run: Path, truth: Path, out: Path) -> dict[str, list[str]]:
    """What reads a run, and writes into `out`."""
    return {
        "status": ["status", str(run)],
        "export": ["export", str(run), "--to", str(out), "-q"],
        "report": ["report", str(run), "--to", str(out / "report.html"), "-q"],
        "evaluate": ["evaluate", str(run), "--truth", str(truth), "-q"],
        "render": ["render", str(run), str(out), "--fps", "1", "-q"],
        "view": ["view", str(run)],
    }


def look_at_all(server: PageServer, out: Path) -> None:
    """In place of serving: write the pages into `out`; then Ctrl-C."""
    out.mkdir(parents=True)
    for part in server.parts():
        page = server.page(part)
        if "<canvas" not in page:
            click.echo(page)
        (out / f"{part}.html").write_text(page)
    raise KeyboardInterrupt


def invoke(arguments: list[str]) -> Result:
    """In this process; a bug is raised."""
    result = CliRunner().invoke(msgs_slam, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def written(out: Path, run: Path) -> dict[str, str]:
    """Digests of what a command has written."""
    files = [p for folder in (out, run / "evaluation") for p in sorted(folder.rglob("*")) if p.is_file()]
    return {p.name: file_sha256(p) for p in files}


def verdict(name: str, result: Result, file: str, same: bool, out: Path) -> str:
    """refused, named, unused, or what is wrong."""
    said = result.stderr + result.stdout
    if file == "manifest.json" and ("is not as the program left it" in said or "missing or damaged" in said):
        return "refused" if "msgs-slam resume" in said else f"WRONG: says {said[-200:]}"  # another run's, or a part
    if name == "report" and result.exit_code == 0 and not same:
        listed = f"<td>{file.removeprefix('export/')}</td><td>missing or damaged"
        return "named" if listed in (out / "report.html").read_text() else "WRONG: used, and nothing said"
    if result.exit_code == 0 and name in ("status", "view") and Path(file).name in said:
        return "named"
    if result.exit_code == 0 and name == "status":
        return "WRONG: status does not name it"
    if result.exit_code == 0:
        return "unused" if same else "WRONG: used, and nothing said"
    return "refused" if Path(file).name in said and "msgs-slam" in said else f"WRONG: says {said[-200:]}"


def chosen_files(run: Path, series: int) -> list[str]:
    """Every file of the run but what commands have added, `series` of those that differ by their number only."""
    found: dict[str, list[str]] = collections.defaultdict(list)
    for stage in STAGES:
        for path in sorted((run / stage).rglob("*")):
            if path.is_file():
                name = path.relative_to(run).as_posix()
                found[re.sub(r"\d{3,}", "#", name)].append(name)
    return ["run.toml", "manifest.json", *(n for names in found.values() for n in names[-series:])]


def resumed(whole: Path, damaged: Path, other: Path) -> list[str]:
    """Stages of which a damaged file does not come back as it was."""
    wrong = []
    for stage in STAGES:
        shutil.rmtree(damaged, ignore_errors=True)
        shutil.copytree(whole, damaged)
        record = (RunFolder(damaged).manifest() or sys.exit("no manifest")).records[stage]
        before = {n: d for n, (_, d) in record.files.items()}
        flip(damaged / stage / min(before), other)
        done = invoke(["resume", str(damaged), "-q"])
        after = {n: file_sha256(damaged / stage / n) for n in before if (damaged / stage / n).exists()}
        if done.exit_code != 0 or after != before:
            wrong.append(stage)
    return wrong


def main() -> None:
    """See the top of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("other", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--series", type=int, default=2)
    options = parser.parse_args()
    damaged, out = options.work / "damaged.msgs", options.work / "out"
    PageServer.serve_forever = lambda server: look_at_all(server, out)  # type: ignore[method-assign, assignment]
    counts: collections.Counter[str] = collections.Counter()
    whole: dict[str, dict[str, str]] = {}
    files = chosen_files(options.run, options.series)
    for file, damage in [("", None), *((f, d) for f in files for d in DAMAGES)]:
        other = options.other / file
        if damage is replace and not other.is_file():
            continue
        if file == "run.toml" and damage in (flip, replace):
            continue  # which may be what the user wants
        shutil.rmtree(damaged, ignore_errors=True)
        shutil.copytree(options.run, damaged)
        if damage is not None:
            damage(damaged / file, other)
            if (damaged / file).exists() and file_sha256(damaged / file) == file_sha256(options.run / file):
                continue  # the other run's file is the same
        for name, arguments in commands(damaged, options.truth, out).items():
            for folder in (out, damaged / "evaluation"):
                shutil.rmtree(folder, ignore_errors=True)
            result = invoke(arguments)
            if damage is None:
                assert result.exit_code == 0, result.output
                whole[name] = written(out, damaged)
                continue
            found = verdict(name, result, file, written(out, damaged) == whole[name], out)
            counts[f"{name}: {found.split(':')[0]}"] += 1
            if found.startswith("WRONG"):
                print(f"{damage.__name__} {file}, {name}: {found}", flush=True)
    wrong = resumed(options.run, damaged, options.other / "run.toml")
    print(json.dumps({"files": len(files), **counts, "not resumed": wrong}, indent=1))
    sys.exit(any("WRONG" in key for key in counts) or bool(wrong))


if __name__ == "__main__":
    main()
