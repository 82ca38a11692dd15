"""Objective of the map: the loss of one view, MSGS-SLAM eq. (18)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ..config import MappingConfig
from ..gaussians.render import Rendering
from . import losses
from .card_loss import TermWeights, card_loss
from .photo_loss import photo_loss
from .views import View

SILHOUETTE_WEIGHT = 0.05
"""Of the pressure towards an opaque map."""


@dataclass(frozen=True)
class Objective:
    """The terms with their weights; `unit`: the scene's median depth."""

    settings: MappingConfig
    unit: float

    def of(
        self,
        view: View,
        exposure: Tensor,
        rendering: Rendering,
        log_radii: Tensor,
        in_view: Tensor | None = None,
    ) -> Tensor:
        """Scalar; `exposure` (2, 3) is the view's, `log_radii` (M,) those of the Gaussians in view, or of all Gaussians
        of a card, of which `in_view` (M,) bool tells them."""
        if in_view is None:
            return self._seen(view, exposure, rendering) + losses.size_loss(log_radii, self.unit)
        weights = TermWeights(SILHOUETTE_WEIGHT, self._depth_weight, self.unit)
        return card_loss(view, exposure, rendering, log_radii, in_view, weights)

    @property
    def _depth_weight(self) -> float:
        return self.settings.depth_weight if self.settings.use_proxy_depth else 0.0

    def _seen(self, view: View, exposure: Tensor, rendering: Rendering) -> Tensor:
        """The terms of every view: what `card_loss` has for cards, without the sizes."""
        loss = photo_loss(rendering.features, exposure, view.image, view.scene)
        loss = loss + SILHOUETTE_WEIGHT * losses.silhouette_loss(view.of_scene(rendering.silhouette, 1.0))
        if self._depth_weight > 0:
            weight = losses.depth_weight(view.trust)
            loss = loss + self._depth_weight * losses.depth_loss(rendering.depth, view.depth, weight, self.unit)
        return loss
