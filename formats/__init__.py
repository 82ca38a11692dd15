"""Bytes to plain arrays and back: video, images, poses, COLMAP, PLY and other splat files, meshes, trajectories.

A file comes in through `reading.opened`, which bounds it, and goes out through `atomic.atomic_path`, whole or not at
all; what is wrong with it is an `errors.InputError` that says what to do. Begin with `video.VideoReader`,
`images.read_rgb` and `datasets.open_sequence`. Imports neither other package.
"""

import zlib  # noqa: F401  pycolmap brings its own zlib, and corrupts memory where Python's is loaded after it
