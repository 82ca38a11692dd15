"""A synthetic world with exact truth, for the demo and the tests."""

from tests.world.build import World
from tests.world.clip import ClipOptions, WorldFrame, make_world, render_frame, render_view, walk
from tests.world.write import iter_clip, write_sequence

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
