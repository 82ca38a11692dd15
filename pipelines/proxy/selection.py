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

from ...formats.errors import InputError, SettingError
from ..config import Config, ProxyConfig
from ..depth.files import LABELS, DatasetMaps, FilesDepth, FolderMaps, MapKind, depth_kind
from ..geometry.sequence import Sequence
from ..labels.files import FilesLabels
from ..networks.card import Card, read_card
from ..networks.network_pass import ResultCache, Workplace
from ..networks.registry import ModelStore, default_cache, missing_networks
from ..networks.words import with_words
from ..providers import MAX_CLASSES, DepthProvider, SemanticsProvider
from ..source.recording import Recording, open_recording
from ..system.progress import Progress, SilentProgress, log
from ..types import Calibration, Frame, Intrinsics

if TYPE_CHECKING:
    from ..depth.stereo.provider import MultiviewDepth
    from ..labels.named import ShapeLabels

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
    is the source; people are left out of a frame, so that no place is one, where `no_people`; with `may_fuse` False
    depth is what its provider says, never fused with multi-view depth."""

    source: Path
    sequence: Sequence
    config: ProxyConfig
    scratch: Callable[[str], Path]
    threads: int
    device: str
    progress: Progress
    recording: Recording | None = None
    no_people: bool = False
    may_fuse: bool = True


@dataclass(frozen=True)
class Choice:
    """A provider as the settings ask for it: the folder of `files`, or the card of a network."""

    kind: str
    folder: str = ""
    card: Card | None = None


def choose_depth(config: ProxyConfig) -> Choice:
    """Raises InputError for a provider that does not exist or a card that is none."""
    return _choose(config.depth, "proxy.depth", OWN_DEPTH, "depth")


def choose_semantics(config: ProxyConfig) -> Choice:
    """Raises InputError for a provider that does not exist or a card that is none."""
    choice = _choose(config.semantics, "proxy.semantics", OWN_SEMANTICS, "segmentation")
    if choice.card is None or choice.card.text is None:
        if config.classes:
            raise InputError(
                "proxy.classes: words of your own need a network that compares images with text: --semantics "
                f"onnx:CARD.toml, whose card has `text`; {choice.card.name if choice.card else choice.kind} does not"
            )
        return choice
    return replace(choice, card=with_words(choice.card, config.classes))


def choose_providers(config: Config) -> tuple[Choice, Choice]:
    """Return those of depth and labels. Raises InputError as `choose_depth` and `choose_semantics` do."""
    return choose_depth(config.proxy), choose_semantics(config.proxy)


def _choose(text: str, setting: str, own: dict[str, Any], task: str) -> Choice:
    """Of one of the `own`, `files:FOLDER`, `onnx:CARD`, the name of a model, or AUTO. Raises SettingError for a kind
    that does not exist or lacks its part."""
    kind, _, rest = text.strip().partition(":")
    if kind in own or kind == "files":
        return Choice(kind, rest)
    store = ModelStore.open()
    if kind in AUTO:
        model = store.first_here(task)
        if kind == "best":
            model = max(store.all_here(task), key=lambda m: m.bytes, default=None)
        return Choice(next(iter(own))) if model is None else Choice("onnx", card=store.card(model))
    models = [m.name for m in store.models]
    if text.strip() in models:
        rest = text.strip()
    elif kind != "onnx":
        kinds = (*AUTO, *own, "files", "onnx")
        near = get_close_matches(kind, [*kinds, *models], n=1, cutoff=0.5)
        guess = f"; did you mean {near[0]}?" if near else "."
        raise SettingError(
            f"{setting}: there is no provider or model {text!r}{guess} It is one of {', '.join(kinds)}, or a network "
            "by its name in `msgs-slam models list`"
        )
    elif not rest:
        raise SettingError(
            f"{setting}: onnx needs the card of a network, onnx:CARD.toml, or its name in `msgs-slam models list`"
        )
    return Choice("onnx", card=_card(store, rest))


def _card(store: ModelStore, text: str) -> Card:
    """The card of a file, or of a model in the cache by its name. Raises InputError when it is neither."""
    model = next((m for m in store.models if m.name == text and not Path(text).exists()), None)
    if model is None:
        return read_card(Path(text))
    if not store.is_here(model):
        raise InputError(f"{text} is not in {store.cache}; run: msgs-slam models pull {text}")
    return store.card(model)


def open_depth(around: ProviderContext) -> DepthProvider:
    """Raises InputError when the provider cannot work on this video."""
    choice = choose_depth(around.config)
    if choice.kind in OWN_DEPTH:
        return OWN_DEPTH[choice.kind](around)
    learned, backbone = open_given_depth(around, choice), around.sequence.backbone
    if choice.card is not None and choice.card.relative:
        from ..depth.learned import AlignedDepth

        learned = AlignedDepth(learned, around.sequence, choice.card.relative)
    if not around.may_fuse or backbone is None or len(backbone.frame_ids) < 2:
        return learned
    from ..depth.fused import FusedDepth, measure_scale

    if choice.card is None:  # a network's depth gains from multi-view depth, a sensor's does not
        posed = [f for f in around.sequence.frames if f.id in around.sequence.cam_from_world]
        strays = measure_scale(around.sequence, posed[:: len(posed) // _FILES_LOOKED_AT + 1], learned.estimate)
        if not strays.spread_in or median(strays.spread_in.values()) <= LEARNED_SPREAD:
            return learned
    return FusedDepth(learned, _multiview(around), around.sequence)


def open_given_depth(around: ProviderContext, choice: Choice) -> DepthProvider:
    """The provider of `files` or of a network, by itself."""
    if choice.card is None:
        return FilesDepth(_maps(around, depth_kind(around.config.depth_scale), choice.folder))
    from ..depth.learned import OnnxDepth

    return OnnxDepth(choice.card, _workplace(around, "network_depth"))


def open_semantics(around: ProviderContext) -> SemanticsProvider:
    """Raises InputError when the provider cannot work on this video."""
    choice = choose_semantics(around.config)
    if choice.kind in OWN_SEMANTICS:
        return OWN_SEMANTICS[choice.kind](around)
    return open_given_semantics(around, choice)


def open_given_semantics(around: ProviderContext, choice: Choice) -> SemanticsProvider:
    """The provider of `files` or of a network, by itself."""
    if choice.card is None:
        return FilesLabels(_maps(around, LABELS, choice.folder), around.progress)
    from ..labels.learned import OnnxClusters, OnnxLabels

    place = _workplace(around, "network_labels")
    if choice.card.is_clustered:
        return OnnxClusters(choice.card, place, MAX_CLASSES)
    return OnnxLabels(choice.card, place, MAX_CLASSES, around.no_people)


def _maps(around: ProviderContext, kind: MapKind, folder: str) -> FolderMaps | DatasetMaps:
    """Those of a folder; without one, those of the data set itself, or files beside the source."""
    recording, frames = around.recording, around.sequence.frames
    if not folder and recording is not None and (dataset := recording.dataset()) is not None:
        return DatasetMaps(kind, dataset, around.sequence)
    turns = {f.id: recording.turns_from_upright(f.source_index) for f in frames} if recording is not None else {}
    path = kind.find_folder(folder, around.source)
    return FolderMaps(kind, path, around.sequence, around.source.is_file(), turns)


def _multiview(around: ProviderContext) -> MultiviewDepth:
    from ..depth.stereo.provider import MultiviewDepth

    side = around.config.stereo_side
    planes = min(STEREO_PLANES, max(_LEAST_PLANES, side // _PIXELS_A_PLANE))
    return MultiviewDepth(
        around.sequence, side, planes, lambda: around.scratch("stereo"), around.threads, around.progress, around.device
    )


def _segments(around: ProviderContext) -> ShapeLabels:
    from ..labels.named import ShapeLabels

    return ShapeLabels(around.sequence, MAX_CLASSES, around.progress)


OWN_DEPTH: dict[str, Callable[[ProviderContext], DepthProvider]] = {"multiview": _multiview}
OWN_SEMANTICS: dict[str, Callable[[ProviderContext], SemanticsProvider]] = {"segments": _segments}
"""Providers that need neither files nor a network; a new one is a line here. `auto` falls back to the first."""


def _workplace(around: ProviderContext, scratch: str) -> Workplace:
    cache = ResultCache(default_cache() / "results", CACHE_MB)
    return Workplace(
        around.sequence, lambda: around.scratch(scratch), around.threads, around.device, around.progress, cache
    )


def check_proxy(source: Path, config: Config) -> None:
    """InputError for a network that is not what its card says, a map of another shape than the images, maps that
    hold nothing, and a scale reference that makes no sense."""
    from .reference import require_reference

    require_reference(source, config)
    depth, semantics = choose_providers(config)
    if config.proxy.semantics == "auto" and (line := missing_networks()):
        log.warning(line)
    opened: list[object] = []
    if depth.kind in ("files", "onnx"):
        opened.append(open_given_depth(_before_frames(source, config), depth))
    if semantics.kind in ("files", "onnx"):
        opened.append(open_given_semantics(_before_frames(source, config), semantics))
    for provider in opened:
        if isinstance(provider, FilesDepth | FilesLabels):
            provider.check()


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
    return ProviderContext(source, sequence, config.proxy, nothing, 1, "cpu", SilentProgress(), pictures)
