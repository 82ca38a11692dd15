"""Bytes to plain arrays and back: video, images, COLMAP, PLY, meshes, trajectories. Imports neither other package."""

import zlib  # noqa: F401  pycolmap brings its own zlib, and corrupts memory where Python's is loaded after it
