"""Settings: round trip, precedence, and refusals that name the nearest key."""

import dataclasses
import itertools
import tomllib
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from msgs_slam.formats.errors import InputError
from msgs_slam.msgs_cli.options import chosen_config
from msgs_slam.pipelines.config import Config, FramesConfig, ProxyConfig, config_to_dict
from msgs_slam.pipelines.run.settings import (
    config_to_toml,
    load_config,
    merge_settings,
    merge_with_quality,
    with_absolute_paths,
)


def test_printed_settings_read_back_the_same(tmp_path: Path) -> None:
    changed = load_config(overrides=["frames.rate=4", 'proxy.depth=files:/a "b"', "run.seed=7"])
    file = tmp_path / "settings.toml"
    file.write_text(config_to_toml(changed))
    assert load_config(file) == changed != Config()


TEXTS = st.text(st.characters(exclude_categories=["Cs"]))


@given(TEXTS, TEXTS, TEXTS)
@example("/home/me/🏠/masks", "𠮷野 \x7f\x1b", 'a "b" \\ # c\r\n\u2028\x85')
def test_every_text_is_read_back_as_it_was_written(masks: str, words: str, poses: str) -> None:
    config = dataclasses.replace(
        Config(), frames=FramesConfig(masks=masks, poses=poses), proxy=ProxyConfig(classes=words)
    )
    assert merge_settings(Config(), tomllib.loads(config_to_toml(config)), "") == config
    assert chosen_config(None, (), {"frames__masks": masks, "frames__poses": poses}).frames == config.frames


def test_text_that_no_file_can_hold_is_refused() -> None:
    with pytest.raises(InputError, match=r"--masks is no valid UTF-8.*rename the file or folder"):
        chosen_config(None, (), {"frames__masks": "K\udcfcche"})
    with pytest.raises(InputError, match=r"frames\.masks is no valid UTF-8"):
        load_config(overrides=["frames.masks=K\udcfcche"])


def test_dots_in_comments_and_texts_divide_no_key(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    dots = "." * 70
    file.write_text(f'# {dots}\n[frames] # {dots} "\nmasks = "{dots}\\" #"\nposes = \'{dots}\'\nmax_side = 320')
    assert load_config(file).frames == FramesConfig(masks=f'{dots}" #', poses=dots, max_side=320)
    file.write_text("a" + ".a" * 70 + ' = "#"')
    with pytest.raises(InputError, match="a key of too many parts"):
        load_config(file)


def test_paths_of_files_that_are_there_become_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("masks", "auto", "multiview", "depth"):
        (tmp_path / name).mkdir()
    (tmp_path / "camera.json").touch()
    typed = ("frames.masks=masks", "frames.poses=gone", "proxy.depth=files:depth", "proxy.semantics=files")
    config = load_config(overrides=[*typed, "export.gps=auto", "frames.intrinsics=./camera.json"])
    whole = with_absolute_paths(config)
    assert (whole.frames.masks, whole.frames.poses) == (str(tmp_path / "masks"), "gone")
    assert whole.frames.intrinsics == str(tmp_path / "camera.json")
    named = with_absolute_paths(load_config(overrides=["frames.intrinsics=camera.json#cam0"]))
    assert named.frames.intrinsics == f"{tmp_path / 'camera.json'}#cam0"
    assert (whole.proxy.depth, whole.proxy.semantics) == (f"files:{tmp_path / 'depth'}", "files")
    assert whole.export.gps == "auto"
    assert with_absolute_paths(load_config(overrides=["proxy.depth=multiview"])).proxy.depth == "multiview"


@pytest.mark.parametrize("name", ["2024_01", "2024-01-31", "1.50", "1e3", "true", "10:30:00"])
def test_a_text_that_toml_takes_for_something_else_is_a_text(name: str) -> None:
    assert load_config(overrides=[f"frames.masks={name}"]).frames.masks == name
    assert load_config(overrides=[f"frames.masks='{name}'"]).frames.masks == name


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
        ("frames.rate=fast", "frames.rate expects a number, got 'fast'"),
        ("frames.rate=true", "frames.rate expects a number, got True"),
        ("frames.rate=nan", "frames.rate is 0.1 to 1000, or 0; got nan"),
        ("frames.rate=-1", "0.1 to 1000, or 0"),
        ("mapping.passes=inf", "mapping.passes is 0 to 1000; got inf"),
        ("mapping.hold_out=1", "mapping.hold_out is 2 to 1000000, or 0"),
        ("export.voxel=1e-9", "export.voxel is 0.0005 to 1"),
        (f"run.seed={10**30}", "run.seed is 0 to 2147483647"),
        ("proxy.depth_scale=1" + "0" * 5000, "proxy.depth_scale expects a number"),
        ("run.seed=1.5", "run.seed expects a whole number, got 1.5"),
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


def test_settings_stay_few() -> None:
    assert sum(len(values) for values in config_to_dict(Config()).values()) <= 47


def test_every_setting_has_help() -> None:
    lines = config_to_toml(Config()).splitlines()
    for before, line in itertools.pairwise(lines):
        if " = " in line and not line.startswith("#"):
            assert before.startswith("# "), line


def test_every_number_has_a_range_around_its_default_that_config_shows() -> None:
    shown = config_to_toml(Config())
    for section in dataclasses.fields(Config):
        for known in dataclasses.fields(type(getattr(Config(), section.name))):
            if isinstance(known.default, bool) or not isinstance(known.default, int | float):
                continue
            name = f"{section.name}.{known.name}"
            low, high = known.metadata["within"]
            assert load_config(overrides=[f"{name}={known.default}"]) == Config()
            for value in (low, high, *((0,) if known.metadata["or_zero"] else ())):
                load_config(overrides=[f"{name}={value}"])
            for value in (low - 1, high * 2 + 1):
                with pytest.raises(InputError, match=f"{name} is {low:.10g} to {high:.10g}".replace(".", r"\.")):
                    load_config(overrides=[f"{name}={value if isinstance(known.default, float) else int(value)}"])
            assert f"{low:.10g} to {high:.10g}" in shown


def test_a_quality_is_a_set_of_values_that_what_is_given_besides_wins_over(tmp_path: Path) -> None:
    normal, draft = Config(), load_config(quality="draft")
    assert draft == load_config(overrides=["run.quality=draft"]) == chosen_config(None, (), {"run__quality": "draft"})
    assert draft.run.quality == "draft"
    assert draft.mapping.passes < normal.mapping.passes
    assert draft.proxy.stereo_side < normal.proxy.stereo_side
    # In whatever order they are given, and where they say what would be normal.
    for words in (["run.quality=draft", "mapping.passes=9"], ["mapping.passes=9", "run.quality=draft"]):
        assert load_config(overrides=words).mapping == dataclasses.replace(draft.mapping, passes=9.0)
    given = chosen_config(None, ["frames.max_side=960"], {"run__quality": "draft", "proxy__depth": "multiview"})
    assert (given.frames.max_side, given.proxy.stereo_side) == (960, draft.proxy.stereo_side)
    both = {"run": {"quality": "draft"}, "mapping": {"passes": 9}}
    assert merge_with_quality(normal, both, "").mapping == dataclasses.replace(draft.mapping, passes=9.0)
    file = tmp_path / "settings.toml"
    file.write_text('[mapping]\npasses = 9\n[run]\nquality = "draft"\n')
    assert load_config(file).mapping.passes == 9
    assert load_config(file).frames == draft.frames
    file.write_text("[mapping]\npasses = 9\n")
    assert load_config(file, quality="draft").mapping.passes == 9
    # A file of all settings is no choice of each of them.
    file.write_text(config_to_toml(load_config(overrides=["frames.rate=7"])))
    assert load_config(file, quality="draft") == load_config(overrides=["frames.rate=7"], quality="draft")


def test_a_run_remembers_its_quality_and_changes_it(tmp_path: Path) -> None:
    draft = load_config(overrides=["frames.parallax=0.08"], quality="draft")
    kept = load_config(base=draft)
    assert kept == draft
    best = load_config(base=draft, quality="best")
    assert best == load_config(overrides=["frames.parallax=0.08"], quality="best")
    assert best.proxy.depth == "best"
    assert load_config(base=best, quality="normal") == load_config(overrides=["frames.parallax=0.08"])
    with pytest.raises(InputError, match=r"--quality is one of draft, normal, best; got 'high'"):
        load_config(quality="high")
    with pytest.raises(InputError, match="did you mean best"):
        load_config(overrides=["run.quality=high"])
