"""What the README and the benchmarks' README say exists: commands, options, settings, files."""

import re
from pathlib import Path

import click
import pytest

from msgs_cli.main import main
from pipelines.config import load_config

ROOT = Path(__file__).resolve().parents[1]
DOCS = [ROOT / "README.md", ROOT / "tests" / "benchmarks" / "README.md"]


def texts() -> str:
    return "\n".join(path.read_text(encoding="utf-8") for path in DOCS)


def test_commands_and_options_exist() -> None:
    found = re.findall(r"^ *msgs-slam ([a-z]+)([^\n#]*)", texts(), flags=re.MULTILINE)
    assert len(found) > 6
    for name, rest in found:
        assert name in main.commands, name
        options = {o for p in main.commands[name].params if isinstance(p, click.Option) for o in p.opts}
        for option in re.findall(r"--[a-z-]+", rest):
            assert option in options, f"msgs-slam {name} {option}"


def test_every_command_is_in_the_readme_or_the_help() -> None:
    told = (main.help or "") + DOCS[0].read_text(encoding="utf-8")
    assert [name for name in main.commands if f"msgs-slam {name}" not in told] == []


@pytest.mark.parametrize("setting", sorted(set(re.findall(r"--set ([a-z_]+\.[a-z_]+=\S+?)[\s`'\"),;]", texts() + " "))))
def test_settings_exist(setting: str) -> None:
    load_config(overrides=[setting])


def test_no_placeholder_is_left() -> None:
    assert not re.findall(r"@[A-Z]+@|TODO|TBD", texts())


def test_named_files_exist() -> None:
    for name in re.findall(r"`((?:tests|pipelines|formats|msgs_cli)/[\w/.]+)`", texts()):
        assert (ROOT / name).exists(), name
    for name in re.findall(r"python (tests/benchmarks/\w+\.py)", texts()):
        assert (ROOT / name).exists(), name


def test_pictures_are_there_and_small() -> None:
    names = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", DOCS[0].read_text(encoding="utf-8"))
    assert names
    for name in names:
        assert 10_000 < (ROOT / name).stat().st_size < 300_000, name
