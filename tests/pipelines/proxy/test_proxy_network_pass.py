"""A network over many frames: cached by content, announced when long; clusters of features; descriptors."""

import logging
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from proxy_room import Room

from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.labels.learned import OnnxClusters, spherical_kmeans
from msgs_slam.pipelines.networks import network_pass
from msgs_slam.pipelines.networks.card import read_card
from msgs_slam.pipelines.networks.network_pass import Arrays, NetworkPass, ResultCache, Workplace
from msgs_slam.pipelines.providers import DepthEstimate
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Calibration, Frame, Intrinsics
from tests.networks import color_tokens


class Counting:
    """Doubles a picture and counts how often it is asked."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, image: NDArray[np.uint8]) -> Arrays:
        self.calls += 1
        return {"double": image.astype(np.float32) * 2}


FRAMES = [Frame(i, f"{i}.png", i / 10, i, 1.0) for i in range(6)]


def picture(frame: Frame) -> NDArray[np.uint8]:
    return np.random.default_rng(frame.id).integers(0, 255, (40, 50, 3)).astype(np.uint8)


CAMERA = Intrinsics(50, 40, 50, 50, 25, 20)
SEQUENCE = Sequence(FRAMES, Calibration(CAMERA, "given", 0.0, (0.0, 0.0, 0.0, 0.0)), CAMERA, None, picture)


def workplace(sequence: Sequence, tmp_path: Path, folder: Path, megabytes: int) -> Workplace:
    cache = ResultCache(tmp_path / "cache", megabytes)
    return Workplace(sequence, lambda: folder, 1, "cpu", SilentProgress(), cache)


def run(tmp_path: Path, name: str, identity: str, megabytes: int = 10) -> tuple[NetworkPass, Counting]:
    counting = Counting()
    folder = tmp_path / name
    folder.mkdir(exist_ok=True)
    place = workplace(SEQUENCE, tmp_path, folder, megabytes)
    whole = NetworkPass("net", identity, place, counting)
    whole.run(FRAMES)
    return whole, counting


def test_another_run_takes_over_what_the_same_network_said_of_the_same_pictures(tmp_path: Path) -> None:
    first, counting = run(tmp_path, "a", "one")
    assert counting.calls == len(FRAMES)
    again, counting = run(tmp_path, "b", "one")
    assert counting.calls == 0
    np.testing.assert_array_equal(again.load(FRAMES[2])["double"], first.load(FRAMES[2])["double"])
    assert run(tmp_path, "c", "two")[1].calls == len(FRAMES)
    # In the same folder nothing is looked up at all.
    assert run(tmp_path, "a", "three")[1].calls == 0


def test_a_damaged_result_is_computed_again_and_no_cache_is_no_harm(tmp_path: Path) -> None:
    run(tmp_path, "a", "one")
    victim = sorted((tmp_path / "cache").iterdir())[0]
    victim.write_bytes(b"torn")
    assert run(tmp_path, "b", "one")[1].calls == 1
    kept = len(list((tmp_path / "cache").iterdir()))
    assert run(tmp_path, "c", "four", megabytes=0)[1].calls == len(FRAMES)
    assert len(list((tmp_path / "cache").iterdir())) == kept


def test_the_cache_is_bounded_and_keeps_what_was_used_last(tmp_path: Path) -> None:
    cache = ResultCache(tmp_path / "cache", 1)
    rng = np.random.default_rng(0)
    for key in ("old", "used", "new"):
        cache.save(key, {"a": rng.integers(0, 255, 450_000).astype(np.uint8)})
    times = {"old": 1, "used": 2, "new": 3}
    for key, at in times.items():
        path = tmp_path / "cache" / f"{key}.npz"
        assert path.exists()
        os.utime(path, (at, at))
    assert cache.load("old") is not None
    cache.trim()
    assert {p.stem for p in (tmp_path / "cache").iterdir()} == {"old", "new"}


def test_a_long_pass_says_how_long(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = iter(range(0, 100_000, 90))
    monkeypatch.setattr(network_pass.time, "monotonic", lambda: float(next(now)))
    with caplog.at_level(logging.WARNING):
        run(tmp_path, "a", "one")
    # Three of six took 90 s each, three are left.
    assert any("about 4 minutes for 3 more frames" in m or "about 5 minutes for 3" in m for m in caplog.messages)
    caplog.clear()
    monkeypatch.setattr(network_pass.time, "monotonic", lambda: 0.0)
    run(tmp_path, "b", "two")
    assert caplog.messages == []


def transformer(folder: Path) -> Path:
    """A class token, then one token a patch that holds the mean colour of the patch; no head."""
    color_tokens(folder / "net.onnx")
    card = folder / "card.toml"
    card.write_text(
        'task="segmentation"\nmodel="net.onnx"\ninput="x"\noutput="tokens"\nkind="tokens"\nwhite=1.0\nmultiple=14\n'
    )
    return card


def test_without_a_head_alike_features_are_a_class(room: Room, tmp_path: Path) -> None:
    colors = np.array([[220, 30, 30], [30, 220, 30], [30, 30, 220]], np.uint8)

    def painted(frame: Frame) -> NDArray[np.uint8]:
        return colors[room.views[frame.id].labels % 3]

    sequence = room.sequence()
    object.__setattr__(sequence, "read_image", painted)
    folder = tmp_path / "scratch"
    folder.mkdir()
    provider: Any = OnnxClusters(
        read_card(transformer(tmp_path)), workplace(sequence, tmp_path, folder, megabytes=0), limit=3
    )

    def depth_of(frame: Frame) -> DepthEstimate:
        depth = (room.views[frame.id].depth * 0.5).astype(np.float32)
        return DepthEstimate(depth, np.ones_like(depth))

    provider.fit(room.frames, depth_of)
    assert provider.classes().names == ("cluster 1", "cluster 2", "cluster 3")
    frame = room.frames[4]
    found = provider.estimate(frame, depth_of(frame))
    truth = room.views[frame.id].labels % 3
    # Every cluster is one of the colours: most of its pixels have it, and no two have the same.
    main = [int(np.bincount(truth[found.labels == c], minlength=3).argmax()) for c in range(3)]
    assert sorted(main) == [0, 1, 2]
    assert (np.array(main)[found.labels] == truth).mean() > 0.85
    assert found.descriptor is not None
    assert found.descriptor == pytest.approx(np.full(3, 3**-0.5), rel=1e-5)


def test_kmeans_finds_directions_largest_first() -> None:
    rng = np.random.default_rng(0)
    counts = (300, 200, 100)
    vectors = np.concatenate([np.eye(5)[k] + rng.normal(size=(n, 5)) * 0.05 for k, n in enumerate(counts)])
    vectors = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    centres = spherical_kmeans(vectors, 3, rng)
    assert (centres @ np.eye(5, dtype=np.float32)).argmax(1).tolist() == [0, 1, 2]
    assert np.linalg.norm(centres, axis=1) == pytest.approx(1, rel=1e-5)
    assert len(spherical_kmeans(np.tile(vectors[:1], (50, 1)), 4, rng)) == 1
