"""Objective of the map: the loss of one view, MSGS-SLAM eq. (18)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from msgs_slam.pipelines.config import MappingConfig, PaperConfig
from msgs_slam.pipelines.gaussians.render import Rendering
from msgs_slam.pipelines.mapping import losses
from msgs_slam.pipelines.mapping.card_loss import TermWeights, card_loss
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
        return self.classes > 0 and self.paper.label_weight > 0 and iteration % LABEL_EVERY == 0

    @property
    def counts_labels(self) -> bool:
        """Whether the classes of the map are counted when it is done, for no term has learnt them."""
        return self.classes > 0 and self.paper.label_weight == 0

    def of(
        self,
        view: View,
        exposure: Tensor,
        rendering: Rendering,
        log_radii: Tensor,
        with_labels: bool,
        in_view: Tensor | None = None,
    ) -> Tensor:
        """Scalar; `exposure` (2, 3) is the view's, `log_radii` (M,) those of the Gaussians in view, or of all Gaussians
        of a card, of which `in_view` (M,) bool tells them."""
        # split, not slices: the gradient of each slice would be a whole image of zeros around it.
        parts = rendering.features.split([3, rendering.features.shape[-1] - 3], dim=-1)
        if in_view is None:
            loss = self._seen(view, exposure, rendering, parts[0])
            loss = loss + losses.size_loss(log_radii, self.unit)
        else:
            weights = TermWeights(SILHOUETTE_WEIGHT, self._depth_weight, self.unit)
            loss = card_loss(view, exposure, rendering, log_radii, in_view, weights)
        return self._with_labels(loss, view, parts[1]) if with_labels else loss

    @property
    def _depth_weight(self) -> float:
        return self.settings.depth_weight if self.settings.use_proxy_depth else 0.0

    def _seen(self, view: View, exposure: Tensor, rendering: Rendering, colors: Tensor) -> Tensor:
        """The terms of every view: what `card_loss` has for cards, without the sizes."""
        loss = photo_loss(colors, exposure, view.image, view.scene)
        loss = loss + SILHOUETTE_WEIGHT * losses.silhouette_loss(view.of_scene(rendering.silhouette, 1.0))
        if self._depth_weight > 0:
            weight = losses.depth_weight(view.trust)
            loss = loss + self._depth_weight * losses.depth_loss(rendering.depth, view.depth, weight, self.unit)
        return loss

    def _with_labels(self, loss: Tensor, view: View, logits: Tensor) -> Tensor:
        """And the paper's semantic term, where it is asked for."""
        by_label = label_image_loss(logits, view.channels, view.label_weight)
        return loss + LABEL_EVERY * self.paper.label_weight * by_label
