"""Selection of providers by the text of the settings, and what of their files is refused before anything slow starts.

A provider's module is imported when it is opened.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from ...formats.datasets import Dataset
from ...formats.errors import InputError, SettingError
from ..config import Config, ProxyConfig
from ..geometry.sequence import Sequence
from ..networks.card import Card, read_card
from ..networks.network_pass import ResultCache, Workplace
from ..networks.registry import ModelStore, default_cache, missing_networks
from ..networks.words import with_words
from ..providers import MAX_CLASSES, DepthProvider, SemanticsProvider
from ..source.recording import FolderRecording, open_recording
from ..system.progress import Progress, SilentProgress, log
from ..types import Calibration, Frame, Intrinsics

if TYPE_CHECKING:
    from ..depth.files import FilesDepth
    from ..depth.learned import OnnxDepth
    from ..depth.stereo.provider import MultiviewDepth
    from ..labels.files import FilesLabels
    from ..labels.learned import OnnxLabels
    from ..labels.segments import SegmentLabels
    from .recording import RecordingDepth, RecordingLabels

LEARNED_SPREAD = 0.02
"""Files whose depths stray by more from the triangulated points, relatively and within one frame, are taken for a
network's. Measured: true depth 0.004, two models of a network 0.056 and 0.059."""
_FILES_LOOKED_AT = 12
STEREO_PLANES, _LEAST_PLANES, _PIXELS_A_PLANE = 128, 32, 5
"""Depths that multiview tries: at most so many, and fewer in small images, where more lie within a pixel."""
CACHE_MB = 2000
"""Megabytes of results of networks that are kept over runs."""
AUTO = ("auto", "best")
"""Words that leave it to the networks in the cache: the first of the table, or the largest."""


@dataclass(frozen=True)
class ProviderContext:
    """Inputs of every provider. `scratch(name)` is a folder that exists as long as the stage is unfinished; `recording`
    is the source's data set, None for a video or plain images; people are left out of a frame, so that no place is one,
    where `no_people`; with `may_fuse` False depth is what its provider says, never fused with multi-view depth."""

    source: Path
    sequence: Sequence
    config: ProxyConfig
    scratch: Callable[[str], Path]
    threads: int
    device: str
    progress: Progress
    recording: Dataset | None = None
    no_people: bool = False
    may_fuse: bool = True


def split_choice(text: str, setting: str, kinds: tuple[str, ...]) -> tuple[str, str]:
    """`files:FOLDER` → ("files", "FOLDER"), and the name of a model NAME → ("onnx", "NAME").

    Raises SettingError for a kind that does not exist or lacks its part.
    """
    kind, _, rest = text.strip().partition(":")
    if kind not in kinds:
        models = [m.name for m in ModelStore.open().models]
        if text.strip() in models:
            return "onnx", text.strip()
        near = get_close_matches(kind, [*kinds, *models], n=1, cutoff=0.5)
        guess = f"; did you mean {near[0]}?" if near else ""
        raise SettingError(
            f"{setting}: there is no provider or model {text!r}{guess or '.'} It is one of {', '.join(kinds)}, or a "
            "network by its name in `msgs-slam models list`"
        )
    if kind == "onnx" and not rest:
        raise SettingError(
            f"{setting}: onnx needs the card of a network, onnx:CARD.toml, or its name in `msgs-slam models list`"
        )
    return kind, rest


@dataclass(frozen=True)
class Choice:
    """A provider as the settings ask for it: the folder of `files`, or the card of a network."""

    kind: str
    folder: str = ""
    card: Card | None = None


def choose_depth(config: ProxyConfig) -> Choice:
    """Raises InputError for a provider that does not exist or a card that is none."""
    return _choose(config.depth, "proxy.depth", tuple(OWN_DEPTH), "depth")


def choose_semantics(config: ProxyConfig) -> Choice:
    """Raises InputError for a provider that does not exist or a card that is none."""
    choice = _choose(config.semantics, "proxy.semantics", tuple(OWN_SEMANTICS), "segmentation")
    if choice.card is None or choice.card.text is None:
        if config.classes:
            raise InputError(
                "proxy.classes: a network that compares images with words finds them, --semantics onnx:CARD.toml "
                f"whose card has `text`; {choice.card.name if choice.card else choice.kind} does not"
            )
        return choice
    return replace(choice, card=with_words(choice.card, config.classes))


def choose_providers(config: Config) -> tuple[Choice, Choice]:
    """Return those of depth and labels. Raises InputError as `choose_depth` and `choose_semantics` do."""
    return choose_depth(config.proxy), choose_semantics(config.proxy)


def _choose(text: str, setting: str, own: tuple[str, ...], task: str) -> Choice:
    kind, rest = split_choice(text, setting, (*AUTO, *own, "files", "onnx"))
    card = _cached(task, kind == "best") if kind in AUTO else _read(rest) if kind == "onnx" else None
    if card is not None:
        return Choice("onnx", card=card)
    return Choice("files", rest) if kind == "files" else Choice(own[0] if kind in AUTO else kind)


def open_depth(around: ProviderContext) -> DepthProvider:
    """Raises InputError when the provider cannot work on this video."""
    choice = choose_depth(around.config)
    if choice.kind in OWN_DEPTH:
        return OWN_DEPTH[choice.kind](around)
    from ..depth.learned import AlignedDepth, OnnxDepth

    learned: DepthProvider = open_learned_depth(around, choice)
    if isinstance(learned, OnnxDepth) and choice.card is not None and choice.card.relative:
        learned = AlignedDepth(learned, around.sequence, choice.card.relative)
    return _fused(around, learned) if _wants_fusion(around, choice, learned) else learned


def _wants_fusion(around: ProviderContext, choice: Choice, learned: DepthProvider) -> bool:
    """Whether the depth gains from multi-view depth: a network's does."""
    if choice.card is not None or not around.may_fuse:
        return around.may_fuse
    from ..depth.fused import measure_scale

    posed = [f for f in around.sequence.frames if f.id in around.sequence.cam_from_world]
    strays = measure_scale(around.sequence, posed[:: len(posed) // _FILES_LOOKED_AT + 1], learned.estimate).spread_in
    return bool(strays) and median(strays.values()) > LEARNED_SPREAD


def open_learned_depth(around: ProviderContext, choice: Choice) -> FilesDepth | RecordingDepth | OnnxDepth:
    """The provider of `files` or of a network, by itself."""
    if choice.card is None:
        return open_depth_files(around, choice.folder)
    from ..depth.learned import OnnxDepth

    return OnnxDepth(choice.card, _workplace(around, "network_depth"))


def open_semantics(around: ProviderContext) -> SemanticsProvider:
    """Raises InputError when the provider cannot work on this video."""
    choice = choose_semantics(around.config)
    if choice.kind in OWN_SEMANTICS:
        return OWN_SEMANTICS[choice.kind](around)
    return open_learned_semantics(around, choice)


def open_learned_semantics(around: ProviderContext, choice: Choice) -> FilesLabels | RecordingLabels | OnnxLabels:
    """The provider of `files` or of a network, by itself."""
    if choice.card is None:
        return open_label_files(around, choice.folder)
    from ..labels.learned import OnnxClusters, OnnxLabels

    place = _workplace(around, "network_labels")
    if choice.card.is_clustered:
        return OnnxClusters(choice.card, place, MAX_CLASSES)
    return OnnxLabels(choice.card, place, MAX_CLASSES, around.no_people)


def open_depth_files(around: ProviderContext, folder: str) -> FilesDepth | RecordingDepth:
    """The depth of a folder; without one, that of the data set itself, or files beside the source."""
    from ..depth.files import FilesDepth
    from .recording import RecordingDepth

    if not folder and around.recording is not None:
        return RecordingDepth(around.recording, around.sequence)
    turns = _turns_of(around)
    return FilesDepth(folder, around.source, around.sequence, around.config.depth_scale, turns)


def open_label_files(around: ProviderContext, folder: str) -> FilesLabels | RecordingLabels:
    """The labels of a folder; without one, those of the data set itself, or files beside the source."""
    from ..labels.files import FilesLabels
    from .recording import RecordingLabels

    if not folder and around.recording is not None:
        return RecordingLabels(around.recording, around.sequence, around.progress)
    turns = _turns_of(around)
    return FilesLabels(folder, around.source, around.sequence, around.progress, turns)


def _turns_of(around: ProviderContext) -> dict[int, int]:
    """Frame id → anticlockwise quarter turns by which its photo is read otherwise than upright, where it is."""
    if around.recording is not None or not around.source.is_dir():
        return {}
    photos = FolderRecording(around.source)
    return {f.id: turn for f in around.sequence.frames if (turn := photos.turns_from_upright(f.source_index))}


def _read(text: str) -> Card:
    """The card of a file, or of a model in the cache by its name. Raises InputError when it is neither."""
    store = ModelStore.open()
    model = next((m for m in store.models if m.name == text and not Path(text).exists()), None)
    if model is None:
        return read_card(Path(text))
    if not store.is_here(model):
        raise InputError(f"{text} is not in {store.cache}; run: msgs-slam models pull {text}")
    return store.card(model)


def _cached(task: str, largest: bool) -> Card | None:
    """The card of the first learned model whose weights are in the cache, or of the one of the largest weights."""
    store = ModelStore.open()
    model = max(store.all_here(task), key=lambda m: m.bytes, default=None) if largest else store.first_here(task)
    return None if model is None else store.card(model)


def _multiview(around: ProviderContext) -> MultiviewDepth:
    from ..depth.stereo.provider import MultiviewDepth

    side = around.config.stereo_side
    planes = min(STEREO_PLANES, max(_LEAST_PLANES, side // _PIXELS_A_PLANE))
    return MultiviewDepth(
        around.sequence, side, planes, lambda: around.scratch("stereo"), around.threads, around.progress, around.device
    )


def _segments(around: ProviderContext) -> SegmentLabels:
    from ..labels.segments import SegmentLabels

    return SegmentLabels(around.sequence, MAX_CLASSES, around.progress)


OWN_DEPTH: dict[str, Callable[[ProviderContext], DepthProvider]] = {"multiview": _multiview}
OWN_SEMANTICS: dict[str, Callable[[ProviderContext], SemanticsProvider]] = {"segments": _segments}
"""Providers that need neither files nor a network; a new one is a line here. `auto` falls back to the first."""


def _fused(around: ProviderContext, learned: DepthProvider) -> DepthProvider:
    """With the multi-view depth where structure from motion has poses for it."""
    if around.sequence.backbone is None or len(around.sequence.backbone.frame_ids) < 2:
        return learned
    from ..depth.fused import FusedDepth

    return FusedDepth(learned, _multiview(around), around.sequence)


def _workplace(around: ProviderContext, scratch: str) -> Workplace:
    cache = ResultCache(default_cache() / "results", CACHE_MB)
    return Workplace(
        around.sequence, lambda: around.scratch(scratch), around.threads, around.device, around.progress, cache
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
    depth, semantics = choose_providers(config)
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
