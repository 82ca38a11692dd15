"""Names of stages and exports, apart from everything heavy so that `--help` is instant."""

STAGES = ("frames", "proxy", "tracking", "mapping", "global_ba", "export")
EXPORTS = (
    "colmap", "ply", "spz", "sog", "glb", "tiles", "html", "mesh", "texture", "collision", "usd", "floorplan", "tum",
)  # fmt: skip
EXTENSION = "extension_"
"""Begins the folder of a run in which what it was before it was extended is kept."""
SOURCE_LIST = "source.videos"
"""The videos of a run of several, in its folder."""
