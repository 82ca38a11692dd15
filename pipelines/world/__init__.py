"""A synthetic world with exact truth, for the demo and the tests."""

from pipelines.world.build import World
from pipelines.world.clip import ClipOptions, WorldFrame, make_world, render_frame, render_view, walk
from pipelines.world.write import iter_clip, write_sequence

__all__ = [
    "ClipOptions",
    "World",
    "WorldFrame",
    "iter_clip",
    "make_world",
    "render_frame",
    "render_view",
    "walk",
    "write_sequence",
]
