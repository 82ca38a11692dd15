"""What the stage reads beside the frames: refused before anything slow, and seen when it changes."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from proxy_room import Room, write_source

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_grey_png
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.proxy.selection import check_proxy
from msgs_slam.pipelines.reconstruct import reconstruct
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.networks import save_network


@pytest.fixture
def source(room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path / "cache"))
    return write_source(room, tmp_path / "source")


def settings(depth: str, semantics: str = "auto") -> Config:
    return load_config(overrides=[f'proxy.depth="{depth}"', f'proxy.semantics="{semantics}"', "run.device=cpu"])


def write_network(path: Path, gain: float, x: str = "x", y: str = "y") -> None:
    mean, scaled = f"m = ReduceMean <axes = [1], keepdims = 1> ({x})", f"{y} = Mul (m, gain)"
    save_network(path, f"float[1, 3, h, w] {x}", f"float[1, 1, h, w] {y}", mean, scaled, gain=[float(gain)])


def test_a_network_that_is_not_here_is_named(source: Path) -> None:
    with pytest.raises(InputError, match="models pull metric3d-small"):
        check_proxy(source, settings("onnx:metric3d-small"))


def no_folder(folder: Path) -> str:
    return f"files:{folder / 'nowhere'}"


def another_shape(folder: Path) -> str:
    for path in (folder / "depth").iterdir():
        write_grey_png(path, np.ones((100, 100), np.uint16))
    return "files"


def one_of_another_shape(folder: Path) -> str:
    write_grey_png(sorted((folder / "depth").iterdir())[7], np.ones((100, 100), np.uint16))
    return "files"


def eight_bits(folder: Path) -> str:
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), np.ones((192, 256, 3), np.uint8))
    return "files"


def filled(folder: Path, kind: str, value: float, dtype: type) -> str:
    for path in (folder / kind).iterdir():
        if dtype is np.uint16:
            write_grey_png(path, np.full((192, 256), value, np.uint16))
        else:
            np.save(path.with_suffix(".npy"), np.full((192, 256), value, dtype))
            path.unlink()
    return "files"


def no_card(folder: Path) -> str:
    return f"onnx:{folder / 'card.toml'}"


def no_weights(folder: Path) -> str:
    (folder / "card.toml").write_text('task="depth"\nmodel="net.onnx"\ninput="x"\noutput="y"\n')
    return no_card(folder)


def wrong_weights(folder: Path) -> str:
    write_network(folder / "net.onnx", 1.0)
    (folder / "card.toml").write_text('task="depth"\nmodel="net.onnx"\ninput="pixels"\noutput="y"\n')
    return no_card(folder)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (no_folder, "no folder with depth files"),
        (another_shape, "not the shape of the frames"),
        (one_of_another_shape, "000007.png is 100x100, which is not the shape"),
        (eight_bits, "depth"),
        (lambda folder: filled(folder, "depth", 0, np.uint16), "hold no depth at all"),
        (lambda folder: filled(folder, "depth", 65535, np.uint16), "hold no depth at all"),
        (lambda folder: filled(folder, "depth", np.nan, np.float32), "hold no depth at all"),
        (lambda folder: filled(folder, "depth", np.inf, np.float64), "hold no depth at all"),
        (no_card, r"no such file: .*card\.toml"),
        (no_weights, r"no net\.onnx beside the card"),
        (wrong_weights, "its inputs are x"),
        (lambda folder: "radar", "no provider or model 'radar'"),
    ],
)
def test_bad_input_is_refused_before_the_frames_are_picked(
    source: Path, tmp_path: Path, spoil: Callable[[Path], str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("msgs_slam.pipelines.run.runner._run_one", lambda *_: pytest.fail("a stage was run"))
    config = settings(spoil(source.parent))
    with pytest.raises(InputError, match=said):
        reconstruct(source, RunFolder(tmp_path / "run"), config, SilentProgress(), "proxy")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("has_table", [True, False])
def test_labels_that_hold_only_void_are_refused_before_the_frames_are_picked(source: Path, has_table: bool) -> None:
    files = sorted((source.parent / "labels").iterdir())
    if not has_table:
        (source.parent / "classes.json").unlink()
    for path in files:
        write_grey_png(path, np.full((192, 256), 0 if has_table else 255, np.uint8))
    with pytest.raises(InputError, match="hold no class at all, only void"):
        check_proxy(source, settings("multiview", "files"))
    write_grey_png(files[-1], np.full((192, 256), 1, np.uint8))
    check_proxy(source, settings("multiview", "files"))
