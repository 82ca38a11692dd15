"""Learned features: ALIKED (Zhao et al., TIM 2023), matched by LightGlue (Lindenberger et al., ICCV 2023).

The networks are the files that COLMAP publishes for itself. pycolmap's wheels are built without what runs them
("requires ONNX support"), so that onnxruntime does; names, padding and thresholds are COLMAP's (feature/aliked.h, 4.2).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.images import to_grey
from ...formats.reading import file_sha256
from ..config import FramesConfig
from ..networks.registry import Model, ModelStore
from ..networks.runtime import Runtime, open_runtime
from ..types import Features

EXTRACTOR, MATCHER = "aliked-n16rot", "aliked-lightglue"
_MULTIPLE = 32
"""Sides of the network's input; the image's last row and column go on to fill it."""
_MIN_SCORE, _MIN_MATCH = 0.2, 0.1
"""Of a feature, and of a match."""
_INPUTS = {"aliked": {"image", "max_keypoints", "min_score"},
           "lightglue": {"kpts0", "kpts1", "desc0", "desc1", "image_size0", "image_size1"}}  # fmt: skip


class LearnedFeatures:
    """Both networks, opened; they may be asked from several threads."""

    def __init__(self, store: ModelStore) -> None:
        """Raises InputError where a file is missing or is not what the table of models says."""
        model = _required(store)
        self._extractor = _opened(store, model)
        self._matcher = _opened(store, store.get(model.needs))

    def extract(self, rgb: NDArray[np.uint8], count: int, left_out: NDArray[np.bool_] | None) -> Features:
        """At most `count` features of an (H, W, 3) image, none in the mask `left_out` (H, W)."""
        height, width = rgb.shape[:2]
        padded = np.pad(rgb, ((0, -height % _MULTIPLE), (0, -width % _MULTIPLE), (0, 0)), "edge")
        feed = {
            "image": np.ascontiguousarray(padded.transpose(2, 0, 1)[None], np.float32) / np.float32(255),
            "max_keypoints": np.array(count, np.int64),
            "min_score": np.array(_MIN_SCORE, np.float32),
        }
        keypoints, descriptors = (found[0] for found in self._extractor.run(["keypoints", "descriptors"], feed))
        # -1 and 1 are the centres of the first and the last pixel.
        xy = (keypoints + 1) / 2 * (np.array(padded.shape[1::-1], np.float32) - 1) + 0.5
        column, row = np.clip(xy.T.astype(np.int64), 0, [[width - 1], [height - 1]])
        kept = (xy >= 0).all(1) & (xy < [width, height]).all(1)
        if left_out is not None:
            kept &= ~left_out[row, column]
        table = np.column_stack([xy, np.ones(len(xy)), np.zeros(len(xy))]).astype(np.float32)
        whole = np.clip(np.round(descriptors * Features.SIGNED_NORM), -127, 127).astype(np.int8)
        return Features(table[kept], whole[kept])

    def match(self, first: Features, second: Features, size: tuple[int, int]) -> NDArray[np.uint32]:
        """(M, 2) indices of features of two images of `size` (width, height) that show the same."""
        if not (len(first) and len(second)):
            return np.zeros((0, 2), np.uint32)
        feed: dict[str, NDArray] = {}
        for number, features in enumerate((first, second)):
            feed[f"kpts{number}"] = (features.keypoints[None, :, :2] - np.float32(0.5)).astype(np.float32)
            feed[f"desc{number}"] = features.descriptors[None].astype(np.float32) / np.float32(Features.SIGNED_NORM)
            feed[f"image_size{number}"] = np.array([size], np.float32)
        partner, score = self._matcher.run(["matches0", "mscores0"], feed)
        partner = partner.astype(np.int64)
        index = np.flatnonzero((partner >= 0) & (partner < len(second)) & (score >= _MIN_MATCH))
        return np.stack([index, partner[index]], axis=1).astype(np.uint32)


def open_learned(settings: FramesConfig) -> LearnedFeatures | None:
    """Open the networks that `frames.features` asks for, None for SIFT. Raises InputError where they are missing."""
    return LearnedFeatures(ModelStore.open()) if settings.features == "aliked" else None


def picture_features(
    rgb: NDArray[np.uint8], left_out: NDArray[np.bool_] | None, settings: FramesConfig, learned: LearnedFeatures | None
) -> Features:
    """Features of an (H, W, 3) image, of the kind that the settings ask for."""
    if learned is not None:
        return learned.extract(rgb, settings.max_features, left_out)
    from ..sfm.features import sift_features  # imports pycolmap

    return sift_features(to_grey(rgb), settings.max_features, left_out)


def _required(store: ModelStore) -> Model:
    if (here := store.first_here("features")) is not None:
        return here
    model = store.get(EXTRACTOR)
    if not store.is_here(model):
        size = (model.bytes + store.get(model.needs).bytes) / 1e6
        raise InputError(
            f"frames.features=aliked needs {EXTRACTOR} and {MATCHER} ({size:.0f} MB), which are not in {store.cache}; "
            f"run: msgs-slam models pull {EXTRACTOR}"
        )
    return model


def _opened(store: ModelStore, model: Model) -> Runtime:
    path: Path = store.path(model)
    if file_sha256(path) != model.sha256:
        raise InputError(f"{path} is damaged; run: msgs-slam models pull {model.name}")
    # One thread each: pairs and images already go side by side, and results must not depend on how many there are.
    runtime = open_runtime(path, [], 1, "cpu")
    if set(runtime.inputs) != _INPUTS[model.family]:
        raise InputError(f"{path}: a network with other inputs is needed: msgs-slam models pull {model.name}")
    return runtime
