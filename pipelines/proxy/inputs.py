"""What is refused before anything slow starts: files and networks that the stage could not use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...formats.errors import InputError
from ..config import Config
from ..networks.registry import missing_networks
from ..providers import Sequence
from ..source.recording import open_recording
from ..system.progress import SilentProgress, log
from ..types import Calibration, Frame, Intrinsics
from .selection import (
    ProviderContext,
    choose_depth,
    choose_semantics,
    open_learned_depth,
    open_learned_semantics,
)


def check_proxy(source: Path, config: Config) -> None:
    """InputError for a network that is not what its card says, a map of another shape than the images, maps that
    hold nothing, and a scale reference that makes no sense."""
    from ..depth.files import FilesDepth, require_sizes
    from ..labels.files import FilesLabels
    from .reference import POSES, require_reference_in

    if config.proxy.scale_ref.strip() == POSES and not config.frames.poses:
        raise InputError("--scale-ref poses needs poses: give them with --poses FILE|FOLDER")
    if config.proxy.scale_ref:
        require_reference_in(open_recording(source, config.run.format), config.proxy.scale_ref)
    depth, semantics = choose_depth(config.proxy), choose_semantics(config.proxy)
    if config.proxy.semantics == "auto" and (line := missing_networks()):
        log.warning(line)
    if not {depth.kind, semantics.kind} & {"files", "onnx"}:
        return
    around = _before_frames(source, config)
    opened: list[object] = []
    if depth.kind in ("files", "onnx"):
        opened.append(open_learned_depth(around, depth))
    if semantics.kind in ("files", "onnx"):
        opened.append(open_learned_semantics(around, semantics))
    for provider in opened:
        if isinstance(provider, FilesDepth | FilesLabels):
            require_sizes(provider.files(), provider.turned(), around.sequence)
            provider.require_content()


def _before_frames(source: Path, config: Config) -> ProviderContext:
    """As if every image of the source were a frame; none of them is decoded."""
    pictures = open_recording(source, config.run.format)
    width, height = pictures.width, pictures.height
    camera = Intrinsics(width, height, width, width, width / 2, height / 2)
    names = [Frame(i, pictures.name(i, i), 0.0, i, 0.0) for i in range(pictures.expected_frames)]
    calibration = Calibration(camera, "given", 0.0, (0.0, 0.0, 0.0, 0.0))
    small = camera.at_most(config.proxy.max_side)

    def nothing(_: Any) -> Any:
        raise AssertionError("providers are only opened here")

    sequence = Sequence(names, calibration, small, None, nothing)
    return ProviderContext(source, sequence, config.proxy, nothing, 1, "cpu", SilentProgress(), pictures.dataset())
