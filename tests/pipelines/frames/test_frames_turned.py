"""A film turned by a quarter gives the same reconstruction, turned: nothing goes by the width where size is meant."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from msgs_slam.formats.images import read_rgb, to_grey, write_rgb
from msgs_slam.pipelines.depth.fields import FINE, FieldGrid, field_scales
from msgs_slam.pipelines.export.texture import _seen
from msgs_slam.pipelines.frames.keyframes import choose_keyframes
from msgs_slam.pipelines.frames.stage import run
from msgs_slam.pipelines.geometry.posed_depth import PosedDepth
from msgs_slam.pipelines.geometry.se3 import align_points, inverse
from msgs_slam.pipelines.masks.moving import _things
from msgs_slam.pipelines.paper.rerender import _field_slopes
from msgs_slam.pipelines.paper.slam import fitted_field
from msgs_slam.pipelines.run.files import BACKBONE, CALIBRATION
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Intrinsics
from tests.pipelines.frames.conftest import QUICK, Walk, render, sideways

Array = NDArray[np.float64]
QUARTER = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Turned from upright camera coordinates, of `np.rot90`."""


def test_keyframes_are_the_same_frames() -> None:
    film = [to_grey(render(center, rotation)) for center, rotation in sideways(20)]

    def frames(quarters: int) -> Iterator[tuple[NDArray[np.uint8], None]]:
        return ((np.ascontiguousarray(np.rot90(image, quarters)), None) for image in film)

    level, upright = (choose_keyframes(frames(quarters), 0.05) for quarters in (0, 1))
    assert 5 < len(level.keyframes) < 30
    assert upright.keyframes == level.keyframes
    assert np.allclose(upright.displacement, level.displacement, rtol=0.02, atol=2e-4)


def test_an_upright_film_keeps_its_overlap() -> None:
    picture = np.random.default_rng(0).integers(0, 255, (30, 70, 1), np.uint8).repeat(16, 0).repeat(16, 1)[..., 0]
    size, shift = (480, 270), 27  # 0.075 of what counts as its length, 0.056 of its longer side
    film = [np.ascontiguousarray(picture[: size[0], shift * i : shift * i + size[1]]) for i in range(4)]
    assert choose_keyframes(((image, None) for image in film), 0.07).keyframes == [0, 1, 2, 3]
    assert choose_keyframes(((image, None) for image in film), 0.12).keyframes == [0, 2, 3]
    turned = [np.ascontiguousarray(image.T) for image in film]
    assert choose_keyframes(((image, None) for image in turned), 0.07).keyframes == [0, 1, 2, 3]


def test_keyframes_have_the_same_poses(bent_walk: Walk, tmp_path: Path) -> None:
    folder = tmp_path / "turned"
    for file in sorted(bent_walk.folder.iterdir()):
        write_rgb(folder / file.name, np.ascontiguousarray(np.rot90(read_rgb(file))))
    found = []
    for source in (bent_walk.folder, folder):
        files = RunFolder(tmp_path / f"run_{source.name}")
        files.stage("frames").mkdir(parents=True)
        run(StageContext(files, source, load_config(overrides=QUICK), files.stage("frames"), SilentProgress()))
        found.append((files.load(BACKBONE), files.load(CALIBRATION)))
    (level, camera), (upright, turned) = found
    assert np.array_equal(upright.frame_ids, level.frame_ids)
    assert turned.intrinsics.fx == pytest.approx(camera.intrinsics.fx, rel=0.01)
    poses = [inverse(model.cam_from_world) for model in (level, upright)]
    move = align_points(poses[1][:, :3, 3], poses[0][:, :3, 3])
    apart = np.linalg.norm(move.apply(poses[1][:, :3, 3]) - poses[0][:, :3, 3], axis=1)
    assert 0 < apart.max() < 1e-3 * np.linalg.norm(np.ptp(poses[0][:, :3, 3], axis=0))
    turns = move.rotation @ poses[1][:, :3, :3] @ QUARTER @ poses[0][:, :3, :3].transpose(0, 2, 1)
    assert np.degrees(np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1))).max() < 0.3


@pytest.mark.parametrize("grid", [FINE, FieldGrid(3, 4)])
def test_nodes_of_a_field_are_as_far_apart(grid: FieldGrid) -> None:
    rng = np.random.default_rng(0)
    nodes, xy = rng.normal(0, 0.1, (grid.rows, grid.columns)), rng.uniform(0, 1, (50, 2)) * [160, 90]
    assert np.array_equal(field_scales(nodes, 160, 90), field_scales(nodes, 90, 160).T)
    level, upright = grid.at(xy, 160, 90), grid.at(xy[:, ::-1], 90, 160)
    assert np.array_equal(level.of(nodes.ravel()), upright.of(nodes.ravel()))
    scales = field_scales(nodes, 160, 90)
    row, column = 41, 33
    here = grid.at(np.array([[column + 0.5, row + 0.5]]), 90, 160)
    assert np.log(scales[row, column]) == pytest.approx(here.of(nodes.ravel())[0], abs=1e-5)


def test_a_field_of_the_paper_is_fitted_along_the_longer_side() -> None:
    rng = np.random.default_rng(0)
    nodes, depth = rng.normal(0, 0.02, (FINE.rows, FINE.columns)), np.full((90, 160), 2.0, np.float32)
    fitted = []
    for proxy, scales in ((depth, field_scales(nodes, 90, 160)), (depth.T, field_scales(nodes, 160, 90))):
        view: Any = SimpleNamespace(depth=torch.from_numpy(proxy.copy()), trust=torch.ones(proxy.shape))
        fitted.append(fitted_field(view, proxy * scales, np.ones(proxy.shape, np.bool_)))
    assert np.allclose(*fitted, atol=1e-6)
    assert np.ptp(fitted[0]) > 0.02


def test_slopes_of_a_field_of_the_paper_are_those_of_its_differences() -> None:
    rng = np.random.default_rng(1)
    nodes, size = rng.normal(0, 0.1, FINE.size), np.array([90, 160])
    xy, step = rng.uniform(5, 80, (40, 2)), 1e-6
    found = _field_slopes(nodes, FINE.at(xy, *size), size)
    for axis in (0, 1):
        moved = FINE.at(xy + step * np.eye(2)[axis], *size).of(nodes) - FINE.at(xy, *size).of(nodes)
        assert np.allclose(found[:, axis], moved / step, atol=1e-6)


def test_a_depth_map_has_as_many_samples() -> None:
    depth, camera = np.ones((180, 320), np.float32), Intrinsics(320, 180, 300.0, 300.0, 160.0, 90.0)
    turned = Intrinsics(180, 320, 300.0, 300.0, 90.0, 160.0)
    level = PosedDepth(camera, np.eye(4), depth, depth).grid(40)
    upright = PosedDepth(turned, np.eye(4), depth.T, depth.T).grid(40)
    assert len(level[1]) == len(upright[1]) == 880


def test_a_texture_fades_over_as_many_pixels() -> None:
    corners, quad = np.array([[-9.0, -9, 2], [9, -9, 2], [9, 9, 2], [-9, 9, 2]]), np.array([[0, 1, 2], [0, 2, 3]])
    nothing, fades = np.zeros((90, 160), np.float32), []
    for width, height in ((160, 90), (90, 160)):
        camera = Intrinsics(width, height, 150.0, 150.0, width / 2, height / 2)
        view = PosedDepth(camera, np.eye(4), *(nothing if width > height else nothing.T,) * 2)
        shot: Any = SimpleNamespace(depth_view=view, camera=camera, hidden=None)
        atlas: Any = SimpleNamespace(mesh=SimpleNamespace(vertices=corners.astype(np.float32), faces=quad))
        fades.append(_seen(atlas, shot)[1])
    assert 0 < fades[0][2, 80] < 1
    np.testing.assert_allclose(fades[1].T, fades[0], atol=1e-6)


def test_pieces_of_what_moves_join_over_the_same_gap() -> None:
    evidence = np.zeros((90, 160), np.bool_)
    evidence[30:60, 40:60] = evidence[30:60, 68:88] = True
    level, upright = _things(evidence, 0.03, None), _things(np.ascontiguousarray(evidence.T), 0.03, None)
    assert level[45, 64]
    assert upright[64, 45]
    assert (level != upright.T).sum() < 20  # OpenCV's disc is not quite as wide as high
