"""The differentiable renderer of isotropic semantic Gaussians."""

from pipelines.gaussians.render.compositing import Composite, composite
from pipelines.gaussians.render.rendering import Rendering, render

__all__ = ["Composite", "Rendering", "composite", "render"]
