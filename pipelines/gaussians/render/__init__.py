"""The differentiable renderer of isotropic semantic Gaussians.

`render` draws a map from a camera, `composite` blends already projected Gaussians; gradients flow through both.
`track_gn` fits a pose to an image, `median_depth` and `blending_weights` look at a map without gradients.
"""

from msgs_slam.pipelines.gaussians.render.compositing import Composite, composite
from msgs_slam.pipelines.gaussians.render.culling import in_view, marked_in_view
from msgs_slam.pipelines.gaussians.render.inspection import (
    BlendingWeights,
    blending_weights,
    class_weights,
    error_shares,
    median_and_seen,
    median_depth,
)
from msgs_slam.pipelines.gaussians.render.rendering import Rendering, render
from msgs_slam.pipelines.gaussians.render.threads import get_threads, host_threads, set_threads
from msgs_slam.pipelines.gaussians.render.tracking import PoseFit, track_gn

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
