"""What may be empty is: no view, no sure pixel, no voxel, no Gaussian, one keyframe, one pixel, NaN everywhere. Nothing
of numpy, torch or OpenCV ends a run then."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from msgs_slam.formats.ply import MeshArrays
from msgs_slam.pipelines.depth.align import (
    COARSE,
    Anchors,
    align_keyframes,
    fit_fields,
    fit_to_points,
    keyframe_scale,
    scale_at_points,
)
from msgs_slam.pipelines.depth.fields import contradicted
from msgs_slam.pipelines.evaluation.film import orbit, resampled, smoothed
from msgs_slam.pipelines.evaluation.html import Line, plot
from msgs_slam.pipelines.evaluation.labels import matched_one_to_one, score
from msgs_slam.pipelines.evaluation.metrics import DepthError, DepthErrorSum, sees, thinned
from msgs_slam.pipelines.evaluation.truth import associate
from msgs_slam.pipelines.evaluation.views import depth_picture, depth_range, view_map
from msgs_slam.pipelines.export.colmap import seen_points
from msgs_slam.pipelines.export.light import lightened, simplified
from msgs_slam.pipelines.export.meshes import with_floor
from msgs_slam.pipelines.export.planes import find_planes
from msgs_slam.pipelines.export.surface import chunk_surfaces, joined, weld
from msgs_slam.pipelines.export.texture import texels_wanted
from msgs_slam.pipelines.export.volume import Grid, fuse, make_grid
from msgs_slam.pipelines.export.walls import find_walls
from msgs_slam.pipelines.geometry.camera import resize_maps
from msgs_slam.pipelines.geometry.posed_depth import PosedDepth, neighbours, overlaps
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.geometry.voxels import (
    Gravity,
    Voxels,
    find_gravity,
    find_near,
    floor_plane,
    gather_depths,
    levels,
    name_structure,
    touching,
    voxel_keys,
)
from msgs_slam.pipelines.mapping.growth import complete_depth, fill_smoothly, seed_spacing
from msgs_slam.pipelines.mapping.losses import depth_loss, fit_exposure
from msgs_slam.pipelines.mapping.measure import depth_view, mesh_view
from msgs_slam.pipelines.mapping.optimise import voted_logits
from msgs_slam.pipelines.mapping.submaps import nearest_seeing
from msgs_slam.pipelines.mapping.views import half_view, make_view, occurring_classes
from msgs_slam.pipelines.paper.mapping import depth_prior
from msgs_slam.pipelines.render.gaussian_map import GaussianMap
from msgs_slam.pipelines.scene.gps import georeference
from msgs_slam.pipelines.scene.metres import Seen, contradiction, usual_evidence
from msgs_slam.pipelines.scene.room import SeenFrame, build_scene
from msgs_slam.pipelines.scene.world import cameras_up, line_planes, up_of_lines
from msgs_slam.pipelines.types import Intrinsics, ProxyMaps

UP = np.array([0.0, -1, 0])
EYE = np.eye(4)
NONE = np.empty(0)
SIZES = ((1, 1), (1, 9), (12, 16))


def camera(height: int, width: int) -> Intrinsics:
    return Intrinsics(width, height, width, width, width / 2, height / 2)


def full(size: tuple[int, int], value: float) -> np.ndarray:
    return np.full(size, value, np.float32)


def posed(size: tuple[int, int], depth: float, trust: float) -> PosedDepth:
    return PosedDepth(camera(*size), EYE, full(size, depth), full(size, trust))


def maps(size: tuple[int, int], depth: float, confidence: float) -> ProxyMaps:
    sure = full(size, confidence)
    return ProxyMaps(full(size, depth), sure, np.zeros(size, np.uint8), sure)


def voxels(count: int) -> Voxels:
    at = np.arange(3.0 * count).reshape(count, 3)
    normal = np.tile(UP, (count, 1))
    return Voxels(0.1, np.sort(voxel_keys(at, 0.1)), np.full(count, 2.0), at, normal, np.zeros((count, 3)))


def model(keyframes: int, observations: int = 0) -> SparseModel:
    poses, zeros = np.tile(EYE, (keyframes, 1, 1)), np.zeros(observations, np.int64)
    points, xy = np.ones((observations, 3)), np.ones((observations, 2))
    return SparseModel(np.arange(keyframes), poses, points, np.zeros((observations, 3), np.uint8), zeros, zeros, xy)


VIEWS = {
    "no view": [],
    "one that is not sure": [posed((12, 16), 0, 0)],
    "one": [posed((12, 16), 2, 1)],
    "one pixel": [posed((1, 1), 2, 1)],
    "one of two is sure": [posed((12, 16), 2, 1), posed((12, 16), 0, 0)],
    "no depth is a number": [posed((12, 16), np.nan, 1)] * 2,
}
MESHES = {
    "no vertex": (np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)),
    "no face": (np.zeros((3, 3), np.float32), np.empty((0, 3), np.int32)),
    "no area": (np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32)),
    "one face": (np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)),
    "upright line": (np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]], np.float32), np.array([[0, 1, 2]], np.int32)),
}


@pytest.mark.parametrize("views", VIEWS.values(), ids=VIEWS)
def test_depths_that_show_nothing(views: list[PosedDepth]) -> None:
    none = Anchors(np.empty((0, 2)), NONE, NONE)
    assert np.isfinite(fit_fields(views, {n: none for n in range(len(views))})).all()
    assert overlaps(views).shape == (len(views), len(views))
    assert len(neighbours(views)) <= 1
    assert len(list(contradicted(views))) == len(views)
    assert len(nearest_seeing(np.ones((3, 3)), views)) == 3
    grid = make_grid(views, 0.05, 4, 100_000)
    empty = Grid(0.05, 0.2, np.empty((0, 3), np.int32), grid.frusta)
    for used, chunks in [*((grid, region) for region in grid.regions()), (empty, empty.blocks)]:
        surface = weld(chunk_surfaces(fuse(used, chunks, views), chunks, 1.0), chunks, 0.05)
        assert np.isfinite(surface.vertices).all()
    found = gather_depths(views, 0.1)
    assert np.isfinite(found.position).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_rooms_of_few_voxels(count: int) -> None:
    few = voxels(count)
    for up in (UP, np.zeros(3)):
        assert np.isfinite(find_gravity(few, up).up).all()
    kinds = name_structure(few, Gravity(UP, True), np.zeros((1, 3)))
    assert len(kinds) == count
    assert floor_plane(few, kinds, UP) is None
    assert len(find_planes(few).normal) == 0
    assert len(touching(few.keys)[0]) == 0
    assert find_near(few.keys, np.array([-1])).tolist() == [-1]
    assert levels(NONE, NONE, 0.1) == []


@pytest.mark.parametrize(("vertices", "faces"), MESHES.values(), ids=MESHES)
def test_meshes_of_nothing(vertices: np.ndarray, faces: np.ndarray) -> None:
    mesh = MeshArrays(vertices, faces, np.zeros((len(vertices), 3), np.uint8), np.zeros(len(vertices), np.uint8))
    assert len(simplified(mesh, 1).faces) == len(faces)
    assert len(lightened(mesh, 1)[1]) == len(faces)
    if len(vertices):
        assert len(with_floor(vertices.astype(float), faces)[1]) >= len(faces)
    assert find_walls(vertices, faces) == []
    assert texels_wanted(vertices, faces, []) == 1


def added(depth: np.ndarray, truth: np.ndarray) -> DepthError | None:
    total = DepthErrorSum()
    total.add(depth, truth)
    return total.result()


def few_poses() -> Iterator[Any]:
    for count in (0, 1, 2):
        poses = np.tile(EYE, (count, 1, 1))
        yield lambda p=poses: (smoothed(p, 2.0), resampled(p, 0))
        yield lambda n=count: align_keyframes(model(n), camera(12, 16), lambda _: None, {})
        yield lambda n=count: align_keyframes(model(n, n), camera(12, 16), lambda _: maps((12, 16), 2, 1), {})
        yield lambda n=count: seen_points(model(n, n), np.arange(n), camera(12, 16), EYE[None].repeat(n, 0))
    yield lambda: (orbit(EYE[None], 2.0, 5, UP), cameras_up(EYE[None]))
    yield lambda: up_of_lines([], np.empty((0, 4, 4)), camera(2, 2), UP)
    yield lambda: (associate(NONE, np.ones(2)), associate(np.full(2, np.nan), np.ones(2)))


def few_pixels() -> Iterator[Any]:
    for size in SIZES:
        photo, k = np.zeros((*size, 3), np.uint8), camera(*size)
        for depth in (full(size, 0), full(size, 2), full(size, np.nan)):
            yield lambda d=depth: depth_picture(d, *depth_range(d))
            yield lambda d=depth, k=k: sees(v := PosedDepth(k, EYE, d, d), v.in_world(*v.grid(320)[:2]))
            yield lambda d=depth: added(d, 0 * d)
            yield lambda d=depth: added(0 * d, d)
            yield lambda d=depth: (complete_depth(d, 0 * d), fill_smoothly(d, 0 * d))
            yield lambda d=depth, p=photo: seed_spacing(p, d, 2, 0.5, 0.5)
            yield lambda d=depth, p=photo: depth_prior(d, np.zeros_like(d), p[..., 0])
        for given in (maps(size, 0, 0), maps(size, np.nan, 1), maps(size, 2, 1), None):
            yield lambda g=given, k=k, p=photo: half_view(make_view(0, k, EYE, p, g, ()))
            if given is not None:
                yield lambda g=given: resize_maps(g, 1, 1)
                yield lambda g=given, k=k: scale_at_points(g, np.empty((0, 2)), NONE, k, 0)
                frame = SeenFrame(photo, given, EYE)
                yield lambda f=frame, k=k: usual_evidence(Seen([f], [0], k, ("floor",), True), None)
        dark = torch.zeros(*size, 3)
        yield lambda d=dark: fit_exposure(d, d, torch.zeros(d.shape[:2], dtype=torch.bool), torch.zeros(2, 3))
        yield lambda d=dark: depth_loss(d[..., 0], d[..., 0], d[..., 0], 1.0)
        yield lambda p=photo, k=k: line_planes(p, k)


def few_others() -> Iterator[Any]:
    yield lambda: keyframe_scale(NONE, NONE)
    nowhere = COARSE.at(np.empty((0, 2)), 4, 3)
    yield lambda: fit_to_points(np.zeros(0, int), nowhere, NONE, NONE, NONE)
    yield lambda: (build_scene([], camera(2, 2), (), True), contradiction([], []))
    yield lambda: (matched_one_to_one(np.zeros((2, 1), np.int64)), score(np.zeros((0, 1), np.int64)))
    yield lambda: (occurring_classes([]), thinned(np.empty((0, 3)), 0.1))
    yield lambda: list(joined(lambda: iter(())).vertices())
    for points in (np.empty((0, 2)), np.zeros((1, 2)), np.full((2, 2), np.nan)):
        yield lambda p=points: plot("t", "x", "y", [Line(p, "#000", "a")], equal=True)
    for count in (0, 1):
        z = torch.zeros
        few = GaussianMap(z(count, 3) - 1, z(count), z(count), z(count, 3), z(count, 2), z(count, dtype=torch.int64))
        yield lambda m=few: (depth_view(m, EYE, camera(1, 1)), mesh_view(m, EYE, camera(12, 16)), voted_logits(m, []))
        yield lambda m=few: view_map(m, np.zeros(3, np.uint8), camera(12, 16), EYE)


@pytest.mark.parametrize("calls", [few_poses, few_pixels, few_others], ids=["poses", "pixels", "others"])
def test_nothing_ends_in_a_library(calls: Callable[[], Iterator[Any]]) -> None:
    count = 0
    for call in calls():
        call()
        count += 1
    assert count > 8


@pytest.mark.parametrize("metric", [True, False])
@pytest.mark.parametrize("count", [0, 2, 8])
def test_places_that_say_nothing(count: int, metric: bool) -> None:
    """A phone without reception writes its last fix into every photo."""
    centers = np.arange(3.0 * count).reshape(count, 3)
    for places in (np.full((count, 3), np.nan), np.tile([55.7, 13.2, 20.0], (count, 1))):
        assert isinstance(georeference(centers, places, metric), str)
