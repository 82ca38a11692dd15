"""Settings: round trip, precedence, and refusals that name the nearest key."""

import itertools
from pathlib import Path

import pytest

from formats.errors import InputError
from pipelines.config import Config, config_to_dict, config_to_toml, load_config
from pipelines.retired_settings import FIXED, MOVED


@pytest.mark.parametrize("comments", [True, False])
def test_printed_settings_read_back_the_same(tmp_path: Path, comments: bool) -> None:
    changed = load_config(overrides=["frames.rate=4", 'proxy.depth=files:/a "b"', "run.seed=7"])
    file = tmp_path / "settings.toml"
    file.write_text(config_to_toml(changed, comments))
    assert load_config(file) == changed != Config()


def test_override_beats_file_beats_default(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    file.write_text("[frames]\nrate = 3\nmax_side = 320\n")
    config = load_config(file, ["frames.rate=5"])
    assert (config.frames.rate, config.frames.max_side, config.run) == (5.0, 320, Config().run)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("frames.raet=5", "did you mean frames.rate?"),
        ("frame.rate=5", "did you mean frames?"),
        ("frames.rate=fast", "frames.rate expects float, got 'fast'"),
        ("frames.rate=true", "frames.rate expects float, got True"),
        ("frames.rate=nan", "must be a number"),
        ("run.seed=1.5", "run.seed expects int, got 1.5"),
        ("run.device=gpu", "one of auto, cpu, cuda"),
        ("rate=5", "expected section.key=value"),
        ("frames.rate", "expected section.key=value"),
    ],
)
def test_wrong_settings_are_refused(override: str, message: str) -> None:
    with pytest.raises(InputError, match="(?s)" + message.replace("?", r"\?")):
        load_config(overrides=[override])


def test_wrong_files_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    for content, message in [
        ("frames = 3", "is a section"),
        ("[frames\n", "no valid TOML"),
        ("[x]\n", "no section 'x'"),
    ]:
        file.write_text(content)
        with pytest.raises(InputError, match=message):
            load_config(file)
    with pytest.raises(InputError, match="no such file"):
        load_config(tmp_path / "missing.toml")


def test_settings_of_earlier_versions_are_refused_with_what_became_of_them(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"mapping\.kappa is article\.kappa now"):
        load_config(overrides=["mapping.kappa=5"])
    file = tmp_path / "old.toml"
    file.write_text("[mapping]\npasses = 3\nmean_rate = 0.1\nprune_weight = 0.0\n")
    with pytest.raises(InputError, match=r"mapping\.mean_rate, mapping\.prune_weight: fixed at what was the default"):
        load_config(file)


def test_retired_settings_are_retired() -> None:
    known = {f"{section}.{key}" for section, values in config_to_dict(Config()).items() for key in values}
    assert not known & {*MOVED, *FIXED}
    assert set(MOVED.values()) <= known
    assert len(known) <= 75


def test_every_setting_has_help() -> None:
    lines = config_to_toml(Config()).splitlines()
    for before, line in itertools.pairwise(lines):
        if " = " in line and not line.startswith("#"):
            assert before.startswith("# "), line
