"""What every backend agrees on: which Gaussian touches which pixel, and when a pixel is finished.

A Gaussian with opacity o and image radius s reaches the pixel centres with distance² <= s² reach(o). There its opacity is
f = min(ALPHA_MAX, o exp(-distance² / 2 s²)) (MSGS-SLAM eq. 4, 5). Gaussians are blended by increasing depth, ties by
index. A pixel takes no more of them once its transmittance before the next one is below TRANSMITTANCE_MIN; with κ > 0
that is the transmittance of the depth chain (eq. 7), which is never the smaller of the two.
"""

from __future__ import annotations

ALPHA_MIN = 1 / 255
"""Opacity at which a Gaussian ends: less cannot be seen in an 8-bit image."""

ALPHA_MAX = 0.99
"""Largest opacity at a pixel: an opaque Gaussian would leave nothing to learn behind it and divide by 0 in gradients."""

TRANSMITTANCE_MIN = 1e-4

CUT_SIGMAS = 3.0
"""No Gaussian reaches farther than this many radii, however opaque."""
