"""The differentiable renderer of isotropic semantic Gaussians.

`render` draws a map from a camera, `composite` blends already projected Gaussians; gradients flow through both.
`track_gn` fits a pose to an image, `median_depth` and `blending_weights` look at a map without gradients.
"""

from .compositing import Composite, composite
from .culling import in_view, marked_in_view
from .inspection import (
    BlendingWeights,
    blending_weights,
    class_weights,
    error_shares,
    median_and_seen,
    median_depth,
)
from .rendering import Rendering, render
from .threads import get_threads, host_threads, set_threads
from .tracking import PoseFit, track_gn

__all__ = [
    "BlendingWeights",
    "Composite",
    "PoseFit",
    "Rendering",
    "blending_weights",
    "class_weights",
    "composite",
    "error_shares",
    "get_threads",
    "host_threads",
    "in_view",
    "marked_in_view",
    "median_and_seen",
    "median_depth",
    "render",
    "set_threads",
    "track_gn",
]
