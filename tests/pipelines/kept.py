"""What `frames` keeps of correspondences, for runs whose frames are made up."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from msgs_slam.formats.images import to_grey
from msgs_slam.pipelines.run.files import FEATURES, MATCHED_PAIRS, VOCABULARY
from msgs_slam.pipelines.sfm.features import learn_vocabulary, sift_features


def keep_correspondences(folder: Path, pictures: Mapping[int, np.ndarray]) -> None:
    """Features of these keyframes (RGB), their vocabulary, and that no pair of them was tried."""
    features = {i: sift_features(to_grey(rgb), 1500, thresholds=(0.005,)) for i, rgb in pictures.items()}
    for frame_id, found in features.items():
        FEATURES.save(folder, found, of=frame_id)
    VOCABULARY.save(folder, learn_vocabulary(list(features.values()), 0))
    MATCHED_PAIRS.save(folder, {})
