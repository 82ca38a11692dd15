"""Person masks by a network."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from .session import Network


def person_probability(network: Network, image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(h, w) in [0, 1]: how likely every pixel of an RGB image (h, w, 3) shows a person.

    Raises InputError when the output is no image of probabilities.
    """
    box = network.box(image.shape[1], image.shape[0])
    output = network.run(image, box)["output"]
    plane = output[0] if output.ndim == 3 and output.shape[0] == 1 else output
    if plane.ndim != 2:
        raise InputError(f"{network.card.model}: gave {output.shape} where one image of probabilities is expected")
    clean = np.clip(np.nan_to_num(plane.astype(np.float32), nan=0.0), 0, 1)
    return box.take(clean, network.card.align_corners)
