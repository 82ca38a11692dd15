"""What every backend agrees on: which Gaussian touches which pixel, and when a pixel is finished.

A Gaussian with opacity o and image radius s reaches the pixel centres at which f = o exp(-distance² / 2 s²) (MSGS-SLAM
eq. 4, 5) is at least ALPHA_MIN and the distance at most CUT_SIGMAS s; there it counts with min(f, ALPHA_MAX). Gaussians
are blended by increasing depth, ties by index. A pixel takes no more of them once its transmittance before the next one
is below TRANSMITTANCE_MIN.
"""

from __future__ import annotations

ALPHA_MIN = 1 / 255
"""Opacity at which a Gaussian ends: less cannot be seen in an 8-bit image."""

ALPHA_MAX = 0.99
"""Largest opacity at a pixel: a fully opaque Gaussian would hide all behind it from learning and divide by 0."""

TRANSMITTANCE_MIN = 1e-4

CUT_SIGMAS = 3.0
"""No Gaussian reaches farther than this many radii, however opaque."""
