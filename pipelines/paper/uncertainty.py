"""Constants of the paper by its own names; proxy depth, how far it is to be trusted, and what symmetry says of it
(section 3.1)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..config import Config
from ..proxy.maps import mean_iou, reliability
from ..run.folder import RunFolder
from ..types import ProxyMaps

Array = NDArray[np.float64]
_SYMMETRY_POINTS = 2000
_SYMMETRY_PROPOSALS = 60


@dataclass(frozen=True)
class Constants:
    """Values of section 4.1, or of the text around the equation, as printed; of a printed range one inside it; the
    comment says where nothing is printed."""

    # (2), (3): reliability of the proxy depth; α and β are the proxy stage's
    gamma: float = 0.5
    steepness: float = 10.0
    """λ of (3), printed without a value."""
    phi: float = 0.5
    """φ of (3), printed without a value."""
    tau_low: float = 0.35
    """The other threshold, τ_high = 0.85, is in no equation: pixels between the two count as those above it."""

    # (7): weight of an occluder
    kappa: float = 0.0
    """κ, in units of the scene's depth, for the map: `run.kappa`; printed without a value. 0, ordinary blending, is
    compiled."""

    # (10) to (14): keyframes
    eta: float = 0.08
    """T_geo of (11)."""
    t_sem: float = 0.65
    most_keyframes: int = 20
    rho: float = 1.0
    """ρ of (13), printed without a value: weights are normalised."""
    tau: float = 0.1
    delta: float = 1.0
    """δ of (14), printed without a value."""
    new_keyframe: float = 0.95
    """A frame that shares less with the last keyframe is a new one; the paper takes every so many-th."""

    # (15), (16): tracking
    t_sil: float = 0.95
    track_depth: float = 0.8
    track_color: float = 1.0
    track_semantic: float = 0.3
    track_iterations: int = 20

    # (17) to (20): mapping
    t_sil_new: float = 0.55
    t_depth: float = 0.1
    """T_depth, of the proxy's depth; printed without a value."""
    nu: float = 1.2
    """ν of (18), printed without a value."""
    map_depth: float = 0.8
    map_color: float = 1.0
    map_semantic: float = 0.15
    map_size: float = 1.0
    """λ_R, printed without a value."""
    map_edge: float = 0.5
    zeta: float = 2000.0
    """ζ of (19), for depth steps in units of the scene's depth; printed without a value."""
    omega: float = 0.2
    clip: float = 1.0
    """Gradients beside class boundaries are clipped to this many times their mean; printed without a value."""
    low_step: float = 0.1
    """Steps of Gaussians of unreliable depth beside those of reliable: 0.001 to 0.005 and 0.01 to 0.05 are printed."""

    # (21) to (24): loops
    theta: float = 0.5
    """θ of (22), printed without a value."""
    rich: float = 0.9
    t_loop: float = 0.6
    """T_loop of (23), printed without a value."""
    alpha1: float = 0.4
    alpha2: float = 0.3
    alpha3: float = 0.3

    # (25), (26): adjustment
    xi: float = 0.15
    """ξ of (26), printed without a value: λ_S of (18)."""


PAPER = Constants()


def constants_of(config: Config) -> Constants:
    """Take the paper's constants, with κ of the settings and without what these switch off: the depth terms."""
    chosen = replace(PAPER, kappa=config.run.kappa)
    if config.mapping.depth_weight > 0:
        return chosen
    return replace(chosen, track_depth=0.0, map_depth=0.0)


def proxy_depth(run: RunFolder, frame_id: int) -> ProxyMaps | None:
    """Eq. (1): D̂_t = Metric3D-V2(I_t): what the stage `proxy` has stored of a frame, None where it gave it no maps.

    Which network, or which files, is the setting `proxy.depth`."""
    return run.find_proxy(frame_id)


def depth_reliability(
    depth: NDArray[np.float32], confidence: NDArray[np.float32], theta: float = 1.0, constants: Constants = PAPER
) -> NDArray[np.float32]:
    """Eq. (2): U = exp(-α‖∇D̂‖²) · Conf^β · θ^γ, (h, w) in [0, 1] of depth and confidence (h, w); 0 at unknown depth.

    Printed β and γ are factors; U could then not pass 0.4, and so never the thresholds printed. Here both are
    exponents. The gradient is that of the logarithm, so that U does not depend on the unit.
    """
    return with_agreement(reliability(depth, confidence), theta, constants)


def semantic_factor(miou: float, constants: Constants = PAPER) -> float:
    """Eq. (3): θ = 1 / (1 + exp(-λ(m_t - φ))) of the mIoU m_t of a frame's classes with those that the map shows."""
    return float(1 / (1 + np.exp(-constants.steepness * (miou - constants.phi))))


def with_agreement(u: NDArray, theta: float, constants: Constants = PAPER) -> NDArray:
    """U of Eq. (2) without its last factor -> with θ^γ."""
    return u * theta**constants.gamma


def semantic_agreement(labels: NDArray[np.uint8], shown: NDArray[np.uint8]) -> float:
    """m_t of Eq. (3): mIoU of two label images (h, w)."""
    return float(mean_iou(labels, shown[None])[0])


@dataclass(frozen=True)
class MirrorPlane:
    """Points x with normal · x = offset; confidence in [0, 1], 0 where no symmetry stands out from chance."""

    normal: Array
    offset: float
    confidence: float


def mirror_plane(points: Array, classes: NDArray[np.integer], tolerance: float, seed: int) -> MirrorPlane:
    """Find the plane that maps most points (P, 3) onto points of the same class (P,), within a tolerance.

    Proposed by pairs of one class; the confidence is the share of points that find a partner beyond what as many do for
    the median proposal, which is chance. Section 3.1 asks that it switches itself off where there is no symmetry.
    """
    rng = np.random.default_rng(seed)
    rows = rng.permutation(len(points))[:_SYMMETRY_POINTS]
    points, classes = points[rows], classes[rows]
    spread = np.ptp(points, axis=0).max(initial=0) if len(points) else 0.0
    spaced = np.column_stack([points, classes * (10 * spread + 1)])
    tree, shares, planes = cKDTree(spaced), [], []
    for _ in range(_SYMMETRY_PROPOSALS if len(points) > 1 else 0):
        first, second = points[rng.choice(len(points), 2, replace=False)]
        if (apart := np.linalg.norm(second - first)) < 10 * tolerance:
            continue
        normal = (second - first) / apart
        offset = float(normal @ (first + second) / 2)
        apart_from_plane = np.abs(points @ normal - offset) > 2 * tolerance  # what lies on the plane mirrors itself
        near, _ = tree.query(mirrored(spaced, normal, offset), distance_upper_bound=tolerance)
        shares.append(float((np.isfinite(near) & apart_from_plane).sum()) / len(points))
        planes.append((normal, offset))
    if not planes:
        return MirrorPlane(np.array([1.0, 0, 0]), 0.0, 0.0)
    best, chance = int(np.argmax(shares)), float(np.median(shares))
    confidence = max(shares[best] - chance - 0.3, 0.0) / 0.7
    return MirrorPlane(*planes[best], confidence)


def mirrored(points: Array, normal: Array, offset: float) -> Array:
    """(P, 3 or more) points with the first three columns mirrored by the plane."""
    out = points.copy()
    out[:, :3] -= 2 * (points[:, :3] @ normal - offset)[:, None] * normal
    return out


def symmetry_pull(points: Array, classes: NDArray[np.integer], plane: MirrorPlane, tolerance: float) -> Array:
    """(P, 3) the points drawn half way to their mirrored partners of the same class, as far as the plane is sure."""
    if plane.confidence == 0 or len(points) == 0:
        return points
    spread = np.ptp(points, axis=0).max()
    spaced = np.column_stack([points, classes * (10 * spread + 1)])
    near, partner = cKDTree(mirrored(spaced, plane.normal, plane.offset)).query(spaced, distance_upper_bound=tolerance)
    found, out = np.isfinite(near), points.copy()
    theirs = mirrored(points, plane.normal, plane.offset)[partner[found]]
    out[found] += 0.5 * plane.confidence * (theirs - points[found])
    return out
