"""The classes of a finished map, counted: each Gaussian takes those of the pixels that it fills.

What eq. (18) of MSGS-SLAM learns by its semantic term in hundreds of visits is, once the map stands, close to a
weighted mean, which takes one drawing of each view (so do Marrie et al., "LUDVIG", ICCV 2025, bring features of images
to a map). Not at half the size: at the outlines of things every pixel counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from ..gaussian_map import GaussianMap
from ..gaussians.render import class_weights
from ..gaussians.seeding import SEED_LOGIT
from .views import View

_FLOOR = 1 / (math.exp(SEED_LOGIT) - 1)
"""Added to every share of a class: one that has all votes gets the logit of a seed's own class, one without any 0."""
_LEAST = 1e-6
"""Pixels: who has less of all views keeps the classes that he has."""


def voted_logits(gaussian_map: GaussianMap, posed: Iterable[tuple[View, Tensor]]) -> Tensor:
    """(M, C) class logits by the labels of views, each with its pose (4, 4): a pixel gives its confidence to its class,
    shared among the Gaussians as they are blended in it."""
    votes = torch.zeros_like(gaussian_map.class_logits)
    m, classes = gaussian_map, gaussian_map.class_logits.shape[1]
    for view, pose in posed:
        seen = (m.means, m.radii, m.opacities, pose, view.intrinsics)
        votes.index_add_(0, *class_weights(*seen, view.channels, view.label_weight, classes))
    total = votes.sum(1, keepdim=True)
    # In place: a number for each class and Gaussian is a large table.
    votes.div_(total.clamp(min=_LEAST)).div_(_FLOOR).log1p_()
    unseen = total[:, 0] <= _LEAST
    votes[unseen] = gaussian_map.class_logits[unseen]
    return votes
