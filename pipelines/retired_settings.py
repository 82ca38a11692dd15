"""Names that are no settings: what became of those that were, and what may be meant by others."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

MOVED = {
    "proxy.symmetry": "paper.symmetry_weight",
    "tracking.depth_weight": "paper.tracking_depth_weight",
    "tracking.label_weight": "paper.tracking_label_weight",
    "mapping.boundary_clip": "paper.boundary_clip",
    "mapping.densify_classes": "paper.class_growth",
    "mapping.edge_weight": "paper.edge_weight",
    "mapping.kappa": "paper.kappa",
    "mapping.label_loss": "paper.label_image",
    "mapping.symmetry_weight": "paper.symmetry_weight",
}
"""Old name → the one that decides it now."""

_FIXED = {
    "frames": "max_match_error peak_threshold",
    "proxy": "alpha beta gamma theta_slope theta_middle",
    "tracking": "flow_window flow_levels flow_error flow_sd feature_sd pose_error min_inliers new_points "
    "keyframe_share relocalise_candidates silhouette color_weight render_loss depth_sd grid_rows grid_columns "
    "adjust_iterations adjust_frames snapshot_every",
    "mapping": "fine_share flat_share window_steps coarse_share color_weight ssim_weight depth_nu label_every "
    "edge_sharpness size_weight size_limit silhouette_weight depth_fields depth_check silhouette_threshold "
    "depth_tolerance densify_every densify_until split_radius prune_opacity prune_weight prune_radius mean_rate "
    "radius_rate opacity_rate color_rate class_rate rate_decay pose_rate exposure_rate low_trust_step time_decay "
    "reliability_decay region_prior",
    "global_ba": "features words loop_shared_points richness loop_similarity miou_weight appearance_weight "
    "structure_weight loop_error loop_share loop_sure_inliers loop_rotation loop_translation loop_drift "
    "loop_angle_drift loop_scale_drift loop_inliers drift_px joint_px loop_candidates loop_appearance",
    "export": "truncation least_weight least_piece",
}
FIXED = frozenset(f"{section}.{name}" for section, names in _FIXED.items() for name in names.split())
"""Constants now, beside the code that uses them, at what was their default."""


GONE = {"frames.max_frames": "however many frames there are, they are taken"}


def explain_retired(keys: Iterable[str]) -> str:
    """What has become of the settings among `keys` (section.name) that there were once; "" for none of them."""
    keys = list(keys)
    moved = [f"{k} is {MOVED[k]} now (off unless set)" for k in keys if k in MOVED]
    fixed = [k for k in keys if k in FIXED]
    moved += [f"{k} is no more: {GONE[k]}" for k in keys if k in GONE]
    if fixed:
        moved.append(f"{', '.join(fixed)}: fixed at what was the default")
    return "; ".join(moved)


_SAME_AS = {"article": "paper", "gpu": "cuda", "nvidia": "cuda", "cuda:0": "cuda", "video": "images", "mp4": "images"}
"""What people type for a choice that has another name."""


def nearest(word: str, known: Iterable[str], prefix: str = "") -> str:
    """; did you mean ...?, or what is known where nothing is near."""
    known = list(known)
    if (meant := _SAME_AS.get(str(word).lower())) in known:
        return f"; did you mean {meant}?"
    matches = difflib.get_close_matches(str(word), known, n=1, cutoff=0.4)
    return f"; did you mean {prefix}{matches[0]}?" if matches else f"; known: {', '.join(known)}"
