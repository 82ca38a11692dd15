"""What the map is optimised for: the loss of one view, MSGS-SLAM eq. (18)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from msgs_slam.pipelines.config import MappingConfig, PaperConfig
from msgs_slam.pipelines.gaussians.render import Rendering
from msgs_slam.pipelines.mapping import losses
from msgs_slam.pipelines.mapping.paper.boundary_clip import clip_beside_boundary
from msgs_slam.pipelines.mapping.paper.edge_term import edge_loss
from msgs_slam.pipelines.mapping.paper.label_image import label_image_loss
from msgs_slam.pipelines.mapping.photo_loss import photo_loss
from msgs_slam.pipelines.mapping.views import View

SILHOUETTE_WEIGHT = 0.05
"""Of the pressure towards an opaque map."""
LABEL_EVERY = 2
"""The semantic terms cost as much as all others together: they count at every second step, twice."""


@dataclass(frozen=True)
class Objective:
    """The terms with their weights; `unit`: the scene's median depth, `classes`: channels of the map."""

    settings: MappingConfig
    paper: PaperConfig
    classes: int
    unit: float

    def uses_labels(self, iteration: int) -> bool:
        """Whether the semantic terms count at this step."""
        wanted = max(self.settings.label_weight, self.paper.edge_weight) > 0
        return self.classes > 0 and wanted and iteration % LABEL_EVERY == 0

    def of(self, view: View, exposure: Tensor, rendering: Rendering, log_radii: Tensor, with_labels: bool) -> Tensor:
        """Scalar; `exposure` (2, 3) is the view's, `log_radii` (M,) the map's."""
        s, paper = self.settings, self.paper
        if paper.boundary_clip > 0:
            clip_beside_boundary(rendering.features, view.channels, paper.boundary_clip)
        # split, not slices: the gradient of each slice would be a whole image of zeros around it.
        shown, logits = rendering.features.split([3, rendering.features.shape[-1] - 3], dim=-1)
        loss = photo_loss(shown, exposure, view.image, view.scene)
        loss = loss + SILHOUETTE_WEIGHT * losses.silhouette_loss(view.of_scene(rendering.silhouette, 1.0))
        loss = loss + losses.size_loss(log_radii, self.unit)
        if s.depth_weight > 0 and s.use_proxy_depth:
            weight = losses.depth_weight(view.trust)
            loss = loss + s.depth_weight * losses.depth_loss(rendering.depth, view.depth, weight, self.unit)
        if with_labels:
            loss = loss + LABEL_EVERY * self._semantic(view, rendering.depth, logits)
        return loss

    def _semantic(self, view: View, depth: Tensor, logits: Tensor) -> Tensor:
        """Labels, and what the paper has beside them."""
        paper, weight = self.paper, self.settings.label_weight
        loss = depth.new_zeros(())
        if weight > 0:
            compare = label_image_loss if paper.label_image else losses.label_loss
            loss = loss + weight * compare(logits, view.channels, view.label_weight)
        if paper.edge_weight > 0:
            loss = loss + paper.edge_weight * edge_loss(depth, view.channels, self.unit)
        return loss
