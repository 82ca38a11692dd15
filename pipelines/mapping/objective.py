"""What the map is optimised for: the loss of one view, MSGS-SLAM eq. (18)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pipelines.config import MappingConfig
from pipelines.gaussians.adam import AdamTable
from pipelines.gaussians.render import Rendering
from pipelines.mapping import losses
from pipelines.mapping.clipping import clip_beside_boundary
from pipelines.mapping.state import expose
from pipelines.mapping.views import View

_EXPOSURE_PULL = 0.1


@dataclass(frozen=True)
class Objective:
    """The terms with their weights; `unit`: the scene's median depth, `classes`: channels of the map."""

    settings: MappingConfig
    classes: int
    unit: float

    def uses_labels(self, iteration: int) -> bool:
        """Whether the semantic terms, which cost as much as all others together, count at this step."""
        s = self.settings
        return self.classes > 0 and s.label_weight > 0 and iteration % s.label_every == 0

    def of(self, view: View, table: AdamTable, rendering: Rendering, log_radii: Tensor, with_labels: bool) -> Tensor:
        """Scalar; `table` holds the view's exposure, `log_radii` (M,) the map's."""
        s = self.settings
        if s.boundary_clip > 0:
            clip_beside_boundary(rendering.features, view.channels, s.boundary_clip)
        # split, not slices: the gradient of each slice would be a whole image of zeros around it.
        shown, logits = rendering.features.split([3, rendering.features.shape[-1] - 3], dim=-1)
        colors = expose(shown, table)
        loss = s.color_weight * losses.image_loss(colors, view.colors, s.ssim_weight)
        loss = loss + s.silhouette_weight * losses.silhouette_loss(rendering.silhouette)
        loss = loss + s.size_weight * losses.size_loss(log_radii, s.size_limit * self.unit)
        if s.depth_weight > 0 and s.use_proxy_depth:
            weight = losses.depth_weight(view.trust, s.depth_nu)
            loss = loss + s.depth_weight * losses.depth_loss(rendering.depth, view.depth, weight, self.unit)
        if s.symmetry_weight > 0 and view.mirrors is not None:
            loss = loss + s.symmetry_weight * losses.symmetry_loss(rendering.depth, view.mirrors, self.unit)
        if with_labels and self.classes > 0:
            loss = loss + s.label_every * self._semantic(view, rendering.depth, logits)
        # Exposures are relative: without a pull to zero they and the colours drift together.
        values = table.values
        return loss + _EXPOSURE_PULL * (values["log_gain"].square().sum() + values["offset"].square().sum())

    def _semantic(self, view: View, depth: Tensor, logits: Tensor) -> Tensor:
        """Labels, and the edge term (19) by which they shape the depth."""
        s = self.settings
        loss = depth.new_zeros(())
        if s.edge_weight > 0:
            edge = losses.edge_loss(depth, view.channels, s.edge_sharpness, self.unit)
            loss = loss + s.edge_weight * edge
        if s.label_weight > 0 and s.label_loss == "image":
            of_labels = losses.label_image_loss(logits, view.channels, view.label_weight, s.ssim_weight)
            loss = loss + s.label_weight * of_labels
        elif s.label_weight > 0:
            loss = loss + s.label_weight * losses.label_loss(logits, view.channels, view.label_weight)
        if s.symmetry_weight > 0 and view.mirrors is not None:
            loss = loss + s.symmetry_weight * losses.label_symmetry_loss(logits, view.mirrors)
        return loss
