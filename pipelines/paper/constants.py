"""Constants of the paper by its own names, with the values of its section 4.1 (or of the text around the equation)."""

from dataclasses import dataclass, replace

from ..config import Config


@dataclass(frozen=True)
class Constants:
    """Values as printed; of a printed range one inside it; the comment says where nothing is printed."""

    # (2), (3): reliability of the proxy depth
    alpha: float = 0.7
    beta: float = 0.8
    """An exponent here: as a factor, which is printed, hardly a pixel would pass tau_low."""
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
