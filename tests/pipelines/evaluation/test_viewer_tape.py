"""The measuring tape against the truth of the made room, and what the viewer's switches leave."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.formats.datasets import Sequence
from msgs_slam.formats.gaussians import GaussianCloud, isotropic_cloud
from msgs_slam.formats.ply import read_gaussian_ply
from msgs_slam.pipelines.geometry.tape import Touch, area, area_text, tape, tape_text, touch
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.types import Metres
from msgs_slam.pipelines.viewer.scene import ViewerScene, load_scenes

OracleRun = Callable[..., RunFolder]


def wall(distance: float, thickness: float, opacity: float = 2.0) -> GaussianCloud:
    """Balls on a grid 1 cm wide about z = distance, scattered in depth."""
    rng = np.random.default_rng(0)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-0.3, 0.3, 0.01), np.arange(-0.3, 0.3, 0.01)))
    means = np.stack([x, y, distance + thickness * rng.normal(size=len(x))], axis=1).astype(np.float32)
    ones = np.ones(len(x), np.float32)
    return isotropic_cloud(means, np.log(0.01) * ones, opacity * ones, np.full((len(x), 3), 0.5, np.float32))


PREFETCH, ORIGIN = np.array([0.0, 0, 1]), np.zeros(3)


@pytest.mark.parametrize("thickness", [0.0, 0.03])
def test_a_wall_is_touched_where_it_is(thickness: float) -> None:
    found = touch(wall(2.0, thickness), ORIGIN, PREFETCH, pixel=0.001)
    assert found is not None
    assert found.point[2] == pytest.approx(2.0, abs=0.004 + thickness)
    assert 0.3 * thickness <= found.along_sd <= 1.2 * thickness + 1e-9
    assert found.across_sd == pytest.approx(0.002, rel=0.05)


def test_flat_discs_are_touched_on_their_plane_and_the_nearer_of_two_walls_first() -> None:
    near, far = wall(1.0, 0.0), wall(2.0, 0.0)
    both = {n: np.concatenate([a, getattr(far, n)]) for n, a in vars(near).items() if a is not None}
    found = touch(GaussianCloud(**both), ORIGIN, PREFETCH, 0.001)
    assert found is not None
    assert found.point[2] == pytest.approx(1.0, abs=0.01)
    # One disc, 1 m wide and 1 mm thick, turned by 45 degrees: its plane is met, not its middle's depth.
    half = np.sqrt(0.5)
    disc = GaussianCloud(
        np.array([[0.3, 0, 2]], np.float32), np.log(np.array([[1, 1, 1e-3]], np.float32)),
        np.array([[np.cos(np.pi / 8), 0, np.sin(np.pi / 8), 0]], np.float32), np.array([9.0], np.float32),
        np.ones((1, 3), np.float32),
    )  # fmt: skip
    met = touch(disc, ORIGIN, PREFETCH, 0.001)
    assert met is not None
    normal = np.array([half, 0, half])
    assert abs((met.point - (0.3, 0, 2)) @ normal) < 1e-3
    assert abs(met.point[2] - 2) > 0.2


def test_nothing_is_touched_where_nothing_is() -> None:
    assert touch(wall(2.0, 0.0), ORIGIN, -PREFETCH, 0.001) is None
    assert touch(wall(2.0, 0.0, opacity=-6.0), ORIGIN, PREFETCH, 0.001) is None


def test_distances_in_the_room_are_true_within_what_is_stated(oracle_run: OracleRun, truth: Sequence) -> None:
    scene = load_scenes(oracle_run().root)[0]
    c = truth.camera
    assert c is not None
    assert truth.world_from_cam is not None
    rng = np.random.default_rng(1)

    def place() -> tuple[Touch, NDArray]:
        while True:
            i = int(rng.integers(0, 8)) * 4
            u, v = int(rng.integers(5, c.width - 5)), int(rng.integers(5, c.height - 5))
            depth, pose = truth.depth(i), truth.world_from_cam[i]
            ray = np.array([(u + 0.5 - c.cx) / c.fx, (v + 0.5 - c.cy) / c.fy, 1])
            found = touch(scene.cloud, pose[:3, 3], pose[:3, :3] @ ray / np.linalg.norm(ray), 1 / c.fx)
            if found is not None:
                return found, pose[:3, :3] @ (depth[v, u] * ray) + pose[:3, 3]

    rows = []
    for _ in range(60):
        (a, true_a), (b, true_b) = place(), place()
        length, sd = tape(a, b)
        rows.append((abs(length - np.linalg.norm(true_a - true_b)), sd))
    error, sd = np.array(rows).T
    assert 0 < np.median(error) < 0.03
    assert 0.4 < np.mean(error < sd) < 0.99
    assert np.mean(error < 3 * sd) > 0.85


def test_a_distance_is_told_in_the_units_there_are() -> None:
    guess = Metres(2.0, 0.09, True, ("a door",))
    assert tape_text(1.5, 0.03, True, None) == "1.500 ± 0.030 m"
    assert tape_text(1.5, 0.03, False, None) == "1.500 ± 0.030 units"
    assert tape_text(1.5, 0.03, False, guess) == "1.500 ± 0.030 units ≈ 3.00 ± 0.28 m"
    assert tape_text(1.5, 0.03, True, Metres(1.0, 0.01, False, ("GPS",))) == "1.500 ± 0.034 m"


@pytest.fixture(scope="module")
def viewer(oracle_run: OracleRun) -> Iterator[Any]:
    pytest.importorskip("viser")
    from msgs_slam.pipelines.viewer.server import open_viewer

    opened = open_viewer(oracle_run(pixel_stride=8, mesh=True).root, port=0)
    yield opened
    opened.stop()


def test_classes_and_box_choose_what_is_shown_and_saved(viewer: Any, tmp_path: Path) -> None:
    scene: ViewerScene = viewer.scene
    assert scene.labels is not None
    chosen = viewer.selection
    assert chosen.rows.all()
    floor = scene.class_names.index("floor")
    chosen.classes[floor].value = False
    assert (chosen.rows == (scene.labels != floor)).all()
    chosen.box[2].value = (0.5, chosen.box[2].value[1])
    chosen.crop.value = True
    # The other two sliders span all but a thousandth.
    inside = (scene.cloud.means[:, 2] >= 0.5) & (scene.labels != floor)
    assert 0.9 * inside.sum() < chosen.rows.sum() <= inside.sum()
    (tmp_path / "seen.ply").write_bytes(chosen.ply())
    saved = read_gaussian_ply(tmp_path / "seen.ply")
    np.testing.assert_allclose(saved.means, scene.cloud.means[chosen.rows], atol=1e-6)
    viewer.show("colour")
    chosen.crop.value = False
    chosen.classes[floor].value = True
    assert chosen.rows.all()


def test_area_of_a_polygon_that_may_be_hollow_and_lean() -> None:
    hollow = np.array([[0.0, 0, 0], [4, 0, 0], [4, 3, 0], [2, 1, 0], [0, 3, 0]])  # 12 less a triangle of 4
    turned = hollow @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0].T + (1, 2, 3)
    assert area(hollow) == pytest.approx(8.0)
    assert area(turned) == pytest.approx(8.0)
    assert area(hollow[:2]) == 0
    assert area_text(8.0, True, None) == "8 m²"
    assert area_text(8.0, False, None) == "8 square units"
    assert area_text(8.0, False, Metres(2.0, 0.09, True, ("a door",))) == "8 square units ≈ 32 m² ± 18 %"
