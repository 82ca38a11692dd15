"""Portions of the keyframes done by workers: the same bytes."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from proxy_room import Room
from test_proxy_stage import tree
from tiny_tflite import write_tflite

from msgs_slam.pipelines.engine.stages import StageContext
from msgs_slam.pipelines.proxy.stage import run
from tests.pipelines.travelling import Travelling

KINDS = {"look_for_depth", "make_depths", "look_for_moving", "look_for_labels", "make_maps"}


def card(folder: Path) -> str:
    """A network that calls bright, red and blue things by three names."""
    folder.mkdir()
    write_tflite(folder / "net.tflite", [[8.0, 8, 8], [8, -8, -8], [-8, -8, 8]], [0, 2, 2], "argmax", (24, 32))
    values = {
        "task": "segmentation", "model": "net.tflite", "input": "image", "output": "scores", "kind": "logits",
        "white": 1.0, "mean": [0.5] * 3, "std": [0.5] * 3, "classes": ["bright", "red", "blue"],
    }  # fmt: skip
    (folder / "card.toml").write_text("".join(f"{k} = {json.dumps(v)}\n" for k, v in values.items()))
    return f"onnx:{folder / 'card.toml'}"


@pytest.mark.parametrize("given", ["embedded", "fused"])
def test_workers_leave_the_same_bytes(
    room: Room, make_context: Callable[..., StageContext], tmp_path: Path, given: str
) -> None:
    """Whatever depends on all frames (scales, what the scene holds) must reach who works on some of them."""
    settings: tuple[str, ...] = ("proxy.stereo_side=64", "proxy.stereo_planes=16", "run.cache_mb=0")
    if given == "fused":
        settings += ("proxy.depth=files", "proxy.fuse=always", f"proxy.semantics={card(tmp_path / 'network')}")
    whole, divided = make_context(*settings), make_context(*settings, name="divided")
    workers = Travelling(tmp_path, 2)
    object.__setattr__(divided, "source", whole.source)
    object.__setattr__(divided, "workers", workers)
    assert run(divided) == run(whole)
    assert tree(divided.folder) == tree(whole.folder)
    assert workers.done == dict.fromkeys(KINDS, 6)
