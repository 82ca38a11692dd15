"""Tracks of a finished model made whole: what verified matches say is one point, and a mapper left in pieces.

A mapper puts tracks together while poses are still rough, and what does not fit then is left out or becomes a second
point. Where few points hold a path, at a door, those are missed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import pycolmap

from .adjust import median_error
from .matching import VerifiedPair

_FAR_OFF = 8.0
"""Median errors within which an observation belongs to a point, at most COLMAP's own limits. Of half, once and twice as
much it is the best on two of four stretches of one made-up walk; COLMAP's four pixels double the error of one."""


def complete_tracks(
    model: pycolmap.Reconstruction, pairs: Iterable[VerifiedPair], seed: int, limit: float | None = None
) -> int:
    """Points of matched features that have none, tracks that go on, and points that are one made one, in place, by
    COLMAP's triangulator; image i + 1 is keyframe i. How many observations were added or merged.

    limit: pixels within which an observation belongs to a point, for poses that are far off."""
    graph = pycolmap.CorrespondenceGraph()
    placed = sorted(model.reg_image_ids())
    for i in placed:
        graph.add_image(i, len(model.images[i].points2D))
    for pair in pairs:
        if graph.exists_image(pair.first + 1) and graph.exists_image(pair.second + 1):
            geometry = pycolmap.TwoViewGeometry(config=pair.config, inlier_matches=pair.matches)
            graph.add_two_view_geometry(pair.first + 1, pair.second + 1, geometry)
    graph.finalize()
    asked, limit = limit, _FAR_OFF * median_error(model) if limit is None else limit
    triangulator = pycolmap.IncrementalTriangulator(graph, model, pycolmap.ObservationManager(model, graph))
    options = pycolmap.IncrementalTriangulatorOptions()
    options.random_seed = seed
    angle = math.degrees(limit / model.cameras[1].mean_focal_length())
    if asked is None:
        limit, angle = min(limit, options.merge_max_reproj_error), min(angle, options.create_max_angle_error)
    options.merge_max_reproj_error = options.complete_max_reproj_error = limit
    options.create_max_angle_error = options.continue_max_angle_error = angle
    found = sum(triangulator.triangulate_image(options, i) for i in placed)
    return found + triangulator.complete_all_tracks(options) + triangulator.merge_all_tracks(options)
