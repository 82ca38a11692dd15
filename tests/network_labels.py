"""Labels of a network alone, at an image's own pixels."""

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.networks.outputs import best_classes, network_probabilities
from msgs_slam.pipelines.networks.session import Network


def network_labels(network: Network, output: NDArray, width: int, height: int) -> tuple[NDArray[np.int64], NDArray]:
    """Return `best_classes` at the pixels of an image of width x height."""
    return best_classes(network_probabilities(network, output, width, height), network.card.void)
