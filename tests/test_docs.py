"""What the README, the benchmarks' README and the site say exists: commands, options, settings, files, messages."""

import ast
import importlib
import json
import math
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from itertools import chain
from pathlib import Path
from types import ModuleType

import click
import pytest

from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.run.settings import load_config

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "docs"
BENCHMARKS = ROOT / "tests" / "benchmarks"
DOCS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "tests" / "benchmarks" / "README.md",
    *sorted(SITE.glob("*.md")),
]


def texts() -> str:
    return "\n".join(path.read_text(encoding="utf-8") for path in DOCS)


def test_commands_and_options_exist() -> None:
    found = re.findall(r"^ *msgs-slam ([a-z]+)([^\n#]*)", texts(), flags=re.MULTILINE)
    assert len(found) > 6
    for name, rest in found:
        assert name in main.commands, name
        if isinstance(main.commands[name], click.Group):
            continue  # its own commands are made below
        options = {o for p in main.commands[name].params if isinstance(p, click.Option) for o in p.opts}
        for option in re.findall(r"--[a-z-]+", rest):
            assert option in options, f"msgs-slam {name} {option}"


@pytest.mark.parametrize("setting", sorted(set(re.findall(r"--set ([a-z_]+\.[a-z_]+=\S+?)[\s`'\"),;]", texts() + " "))))
def test_settings_exist(setting: str) -> None:
    load_config(overrides=[setting])


def of_benchmarks(name: str) -> ModuleType:
    """A script of the benchmarks."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.pop(0)


def test_figures_of_quality_stand_in_one_file() -> None:
    """`python tests/benchmarks/figures.py` writes them into the pages; no sentence beside them states one."""
    script = of_benchmarks("figures")
    figures, pages = script.stated()
    free = {"docs/figures.md", "docs/method.md", "docs/public.md", "tests/benchmarks/README.md", "CONTRIBUTING.md"}
    for path in DOCS:
        text, name = path.read_text(encoding="utf-8"), path.relative_to(ROOT).as_posix()
        assert script.with_figures(text, pages.get(name, []), figures) == text, name
        assert name in free or script.others(text, pages.get(name, [])) == [], name
    readme, sentences = DOCS[0].read_text(encoding="utf-8"), pages["README.md"]
    figures["kitchen"] |= {"psnr": 31.4, "date": "3 March"}
    other = script.with_figures(readme, sentences, figures)
    assert other.count("| 31.4 dB | 5 min, 1.6 GB | 3 March |") == 1 - readme.count("31.4 dB")
    assert script.others(other + "Draft reaches 30 dB.", sentences) == ["30 dB"]
    with pytest.raises(ValueError, match="stands 2 times"):
        script.with_figures(other + other, sentences, figures)


def test_no_placeholder_is_left() -> None:
    assert not re.findall(r"@[A-Z]+@|TODO|TBD", texts())


def test_named_files_exist() -> None:
    for name in re.findall(r"`((?:tests|pipelines|formats|msgs_cli)/[\w/.]+)`", texts()):
        assert (ROOT / name).exists(), name
    for name in re.findall(r"python (tests/benchmarks/\w+\.py)", texts()):
        assert (ROOT / name).exists(), name


def test_every_benchmark_is_on_its_page() -> None:
    page = (BENCHMARKS / "README.md").read_text(encoding="utf-8")
    assert [path.name for path in BENCHMARKS.glob("*.py") if path.name not in page] == []


def test_constants_that_a_benchmark_changes_stand_in_the_code() -> None:
    tree = ast.parse((BENCHMARKS / "constants.py").read_text(encoding="utf-8"))
    tables = [
        ast.literal_eval(n.value) for n in tree.body if isinstance(n, ast.Assign) and isinstance(n.value, ast.Dict)
    ]
    places = [place for table in tables for place in table.values()]
    assert len(places) > 20
    for file, line, number in places:
        assert line in (ROOT / "pipelines" / "depth" / file).read_text(encoding="utf-8"), line
        assert number in line


def test_commands_of_benchmarks_are_understood(tmp_path: Path) -> None:
    """Every script starts and its own parser takes what the pages give it; nothing is measured."""
    commands = re.findall(r"python (?:-m )?(tests[/.]benchmarks[/.]\w+(?:\.py)?)((?:\\\n|[^\n`#>|])*)", texts())
    words = [[name, *shlex.split(re.sub(r"\\\n|\.{3}|[][]", " ", rest))] for name, rest in commands]
    scripts = [p for p in sorted(BENCHMARKS.glob("*.py")) if '"__main__"' in p.read_text(encoding="utf-8")]
    words += [[str(p.relative_to(ROOT)), "--help"] for p in scripts]
    assert len(words) > len(scripts) + 40
    given = json.dumps([[str(ROOT / w[0]) if w[0].endswith(".py") else w[0], *w[1:]] for w in words])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(BENCHMARKS)])}
    done = subprocess.run(
        [sys.executable, "-c", _PARSES, given], cwd=tmp_path, env=environment, capture_output=True, text=True
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout.splitlines()[-1]) == []


_PARSES = """
import argparse, contextlib, io, json, runpy, sys
right = argparse.ArgumentParser.parse_args
def parse(self, *arguments, **named):
    right(self, *arguments, **named)
    raise SystemExit(0)
argparse.ArgumentParser.parse_args = parse
wrong = []
for command in json.loads(sys.argv[1]):
    sys.argv, path, said, code = list(command), list(sys.path), io.StringIO(), "it went on without parsing"
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            run = runpy.run_path if command[0].endswith(".py") else runpy.run_module
            run(command[0], run_name="__main__")
    except SystemExit as end:
        code = end.code
    except ImportError as error:  # of an extra that is not installed, of ours not: an architecture test says which
        code = 0 if error.name in {"pytest", "ray", "evo", "av", "sklearn"} else repr(error)
    except Exception as error:
        code = repr(error)
    sys.path[:] = path
    if code:
        wrong.append([command, code, said.getvalue()[-300:]])
print(json.dumps(wrong))
"""


@pytest.mark.parametrize("what", [[], ["--iteration", "--pose", "--memory"]], ids=["table", "others"])
def test_the_bench_of_the_renderer_runs(what: list[str], tmp_path: Path) -> None:
    """On images of a thumbnail's size: what its backends can do changes, and it calls them itself."""
    tiny = f"import sys; sys.path.insert(0, {str(BENCHMARKS)!r}); import renderer"
    tiny += "; renderer.ROWS = 4 * [(48, 32, 300, 4)]; renderer.main()"
    rows = tmp_path / "rows.json"
    words = ["-c", tiny, "--device", "cpu", "--repeats", "1", "--json", str(rows), *what]
    done = subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    if what:
        assert len(done.stdout.splitlines()) >= 3
    else:
        assert {row["backend"] for row in json.loads(rows.read_text())} == {"cpu", "reference"}


def test_pictures_are_there_and_small() -> None:
    names = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", DOCS[0].read_text(encoding="utf-8"))
    assert names[0].endswith("desk.webp"), "a real recording first"
    for name in names:
        assert 10_000 < (ROOT / name).stat().st_size < (2_000_000 if name.endswith("webp") else 300_000), name


def test_pictures_show_the_program_of_today() -> None:
    """Colours of classes, the page and the report; what is older is to be made anew."""
    script = of_benchmarks("docs_pictures")
    shown, today = json.loads((SITE / "pictures" / "shown.json").read_text()), script.today()
    assert shown.keys() == script.SHOWN.keys()
    older = {name: [part for part in script.SHOWN[name] if shown[name].get(part) != today[part]] for name in shown}
    assert not any(older.values()), f"older than what they show: {older}: `docs_pictures.py ... --only` makes them anew"


@pytest.mark.parametrize("line", sorted(set(re.findall(r"^msgs-slam [a-z].*$", texts(), flags=re.MULTILINE))))
def test_commands_of_the_docs_are_understood(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names, options and the kind of every value, by the program's own parser; nothing is run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "DATASET").mkdir()
    (tmp_path / "video.msgs").mkdir()
    command: click.Command = main
    words = shlex.split(line.partition(">")[0], comments=True)[1:]
    with click.Context(main, **main.context_settings) as context:
        while isinstance(command, click.Group):
            _, found, words = command.resolve_command(context, words)
            assert found is not None
            command = found
        command.make_context(command.name, words, parent=context)


def messages() -> Iterator[str]:
    """Every text in the code that is longer than a word, with … in place of what is filled in."""
    for room in ("msgs_cli", "pipelines", "formats"):
        for path in (ROOT / room).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.JoinedStr):
                    yield "".join(str(v.value) if isinstance(v, ast.Constant) else "…" for v in node.values)
                elif isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
                    yield node.value


def test_messages_explained_are_still_given() -> None:
    """As a whole, or as the beginning of a longer one."""
    text = (SITE / "troubleshooting.md").read_text(encoding="utf-8")
    explained = [m.strip() for m in re.findall(r"^### (.*)$", text, flags=re.MULTILINE)]
    given = {re.sub(r"…+", "…", m) for m in messages()}
    assert len(explained) > 30
    assert [m for m in explained if not any(g.startswith(re.sub(r"…+", "…", m)) for g in given)] == []


def test_site_is_built_without_a_broken_link(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    pages = {path.stem: path.read_text(encoding="utf-8") for path in tmp_path.glob("*.html")}
    assert {path.stem for path in SITE.glob("*.md")} | {"settings", "commands"} <= set(pages)
    assert "mapping" in pages["settings"]
    for name in main.commands:
        assert f"msgs-slam {name}" in pages["commands"], name
    assert pages["method"].count("<math") > 20
    assert "arithmatex" not in pages["method"]
    assert "world_from_cam" in pages["python"]
    # Nothing is fetched from elsewhere: the site works from the disk.
    for name, page in pages.items():
        assert not re.findall(r'(?:src|<link[^>]* href)="https?://[^"]*"', page), name
        assert not re.findall(r"8 ?(?:&lt;|<)", re.sub(r"<[^>]+>", "", page)), f"{name}: a snippet was not put in"
    assert "def write_class_boxes" in re.sub(r"<[^>]+>", "", pages["extending"])
    assert (tmp_path / "search" / "search_index.js").is_file()  # as a script, which pages opened from the disk can load


def test_settings_page_has_every_setting() -> None:
    pytest.importorskip("mkdocs")
    pytest.importorskip("latex2mathml")
    sys.path.insert(0, str(SITE))
    try:
        from hooks import settings_page
    finally:
        sys.path.pop(0)
    page = settings_page()
    for section in fields(Config):
        for key in fields(getattr(Config(), section.name)):
            assert f"| `{key.name}` |" in page.split(f"## {section.name}\n")[1].split("\n## ")[0], key.name
    assert not re.findall(r"^\| `\w+` \| `[^|]*` \|  \|", page, flags=re.MULTILINE)  # what each may be


def test_the_page_of_public_recordings_is_that_of_the_figures_kept() -> None:
    """`python tests/benchmarks/public.py` writes it."""
    public = of_benchmarks("public")
    kept = json.loads(public.KEPT.read_text(encoding="utf-8"))
    text = public.PAGE.read_text(encoding="utf-8")
    assert text == public.page(kept)
    assert text.count("| run here |") == 9
    assert "| MSGS-SLAM | yes | parts only, below |" in text
    assert set(kept["sequences"]) <= {*public.PARTS, *chain.from_iterable(public.SETS.values())}


def test_a_whole_set_that_was_run_has_its_means_on_the_page() -> None:
    public = of_benchmarks("public")
    kept = json.loads(public.KEPT.read_text(encoding="utf-8"))
    row = {"posed": 9, "frames": 10, "sd": 0.1, "deviations": 0.5, "cpu_seconds": 60.0, "part": ""}
    for k, name in enumerate(public.SETS["Replica"]):
        assert "| parts only, below | parts only, below | parts only, below | – |" in public.page(kept)
        kept["sequences"][name] = row | {"sim3_cm": 1.0 + k, "se3_cm": 2.0 + k, "scale": 0.9 + 0.1 * k}
    text = public.page(kept)
    assert "| parts only, below | parts only, below | 4.50 / 5.5 | – / – / 1.25 |" in text
    assert "| office0 | whole | 9 of 10 | 1.00 | 2.0 | 0.90 ± 10% | 0.5 | 60 |" in text


def test_a_sequence_is_measured_from_its_images_alone(world_sequence: Path, tmp_path: Path) -> None:
    """Metres are those that the run itself estimates: exact ones for the shape, and an honest deviation."""
    small = ("frames.max_features=500", "proxy.stereo_side=64")
    row = of_benchmarks("public").measure_sequence(world_sequence, tmp_path / "world.msgs", small)
    assert row["posed"] == row["frames"] == 32
    assert 0 < row["sim3_cm"] < 3
    assert row["sim3_cm"] < row["se3_cm"] < 100
    assert row["deviations"] == pytest.approx(abs(math.log(row["scale"])) / row["sd"])
    assert row["deviations"] < 3


def test_the_man_page_is_that_of_todays_commands() -> None:
    """`python docs/man_page.py` writes it."""
    sys.path.insert(0, str(SITE))
    try:
        from man_page import PAGE, man_page
    finally:
        sys.path.pop(0)
    page = PAGE.read_text(encoding="utf-8")
    assert page == man_page()
    for name, command in main.commands.items():
        assert f"\n.SH MSGS\\-SLAM {name.upper()}\n" in page
        assert all(
            max(p.opts, key=len).replace("-", "\\-") in page
            for p in command.params
            if isinstance(p, click.Option) and not p.hidden
        )
    assert not re.findall(r"^['.](?!TH|SH|PP|TP|BR?|nf|fi)", page, re.MULTILINE)


def test_dockerfile_copies_what_is_here_and_asks_for_the_same_torch() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    copied = [name for line in re.findall(r"^COPY (?!--from)(.*) \S+$", text, re.MULTILINE) for name in line.split()]
    assert {"msgs_slam", "pipelines", "formats", "msgs_cli"} <= set(copied)
    assert [name for name in copied if not (ROOT / name).exists()] == []
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    assert re.findall(r'"(torch[^"]*)"', text) == [name for name in wanted if name.startswith("torch")]


def test_the_install_is_the_same_everywhere() -> None:
    """In README, on the site and in the Makefile; PyTorch for the CPU only where there is no NVIDIA driver."""
    readme, home, tour = (
        re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)[0]
        for page in (DOCS[0], SITE / "index.md", SITE / "tour.md")
    )
    assert readme == home
    assert re.findall(r"^(git clone|make demo|msgs-slam \w+)", readme, re.MULTILINE) == [
        "git clone", "make demo", "msgs-slam reconstruct", "msgs-slam view",
    ]  # fmt: skip
    longer = re.findall(r"```sh\n(.*?)```", DOCS[0].read_text(encoding="utf-8").split("## Install")[1], re.DOTALL)[0]
    lines = [[re.sub(r"\s+#.*", "", line) for line in block.splitlines()] for block in (longer, tour)]
    assert lines[0][:3] == lines[1][:3]
    torch, install = lines[0][1:3]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    without_card, _, wanted = torch.partition(" || pip install ")
    assert without_card == "nvidia-smi > /dev/null 2>&1"
    assert f"{without_card} || " in makefile
    assert f"CPU_TORCH := {wanted}\n" in makefile
    assert f"$(PIP) {install.removeprefix('pip install ')}\n" in makefile.split("\ndemo:")[1].split("\n\n")[0]
    needs = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    assert shlex.split(wanted)[0] in needs
    assert "python3 -m venv .venv && . .venv/bin/activate" in lines[0], "Debian and Ubuntu refuse pip outside of one"


def test_metadata_agrees_with_itself() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    (everything,) = extras["all"]
    named = re.findall(r"\w+", everything.partition("[")[2])
    assert sorted(named) == sorted(set(extras) - {"all", "cuda-check", "docs", "dev"})
    asked_for = set(re.findall(r"msgs-slam\[([\w,]+)\]", texts() + "\n".join(messages())))
    assert {name for group in asked_for for name in group.split(",")} <= set(extras)
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"version: {project['version']}" in citation
    assert project["urls"]["Method"].removeprefix("https://doi.org/") in citation
    assert project["description"] in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
