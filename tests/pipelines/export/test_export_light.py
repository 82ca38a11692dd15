"""A lighter mesh: how many faces, whose classes, what rims."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from msgs_slam.formats.ply import MeshArrays
from msgs_slam.pipelines.export.light import areas, clustered, lightened, simplified, smoothed_rims


def sheet(side: int = 120, noise: float = 0.0) -> MeshArrays:
    """A square of side 1 in z = 0; within 0.3 of its middle class 5, else class 2, and a speck of class 9."""
    y, x = np.mgrid[:side, :side] / (side - 1)
    z = noise * np.random.default_rng(0).normal(size=x.shape)
    number = np.arange(side * side).reshape(side, side)
    a, b, c, d = (number[r, s].ravel() for r, s in (np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]))
    faces = np.concatenate([np.stack(f, 1) for f in ((a, b, c), (b, d, c))]).astype(np.int32)
    labels = np.where(np.hypot(x - 0.5, y - 0.5) < 0.3, 5, 2)
    labels[5:8, 5:8] = 9
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    return MeshArrays(points, faces, np.zeros((len(points), 3), np.uint8), labels.ravel().astype(np.uint8))


def wrong(light: MeshArrays, labels: NDArray[np.uint8]) -> float:
    """The area that bears the other class."""
    shares = np.random.default_rng(1).dirichlet([1, 1, 1], 500)
    points = np.einsum("sk,fkc->fsc", shares, light.vertices[light.faces])
    inside = np.hypot(points[..., 0] - 0.5, points[..., 1] - 0.5) < 0.3
    share = (inside != (labels == 5)[:, None]).mean(axis=1)
    return float((share * areas(light.vertices, light.faces)).sum())


def test_no_face_reaches_over_the_border_of_a_class() -> None:
    mesh = sheet(noise=1e-4)
    light, labels = lightened(mesh, 600)
    assert 200 < len(light.faces) <= 600
    assert set(labels) == {2, 5}  # the speck is as what is around it
    step = 1 / 119
    assert wrong(light, labels) < 2 * np.pi * 0.3 * 0.5 * step
    without = simplified(mesh, 600)
    other = without.labels[without.faces]
    assert wrong(without, np.median(other, axis=1).astype(np.uint8)) > 2 * wrong(light, labels)
    made = trimesh.Trimesh(light.vertices, light.faces, process=False)
    assert made.area == pytest.approx(1, rel=0.02)
    assert np.unique(np.sort(made.edges, axis=1), axis=0, return_counts=True)[1].max() == 2  # no fin is left


def test_a_step_of_voxels_becomes_a_line() -> None:
    mesh = sheet(40)
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    steps = MeshArrays(mesh.vertices, mesh.faces[middles[:, 0] < middles[:, 1] + 0.2], mesh.colors, mesh.labels)

    def rim(mesh: MeshArrays) -> NDArray[np.float32]:
        edges, counts = np.unique(
            np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_counts=True
        )
        points = mesh.vertices[np.unique(edges[counts == 1])]
        inside = (points[:, :2] > 0.12).all(axis=1) & (points[:, :2] < 0.88).all(axis=1)
        return points[inside, 0] - points[inside, 1] - 0.2

    assert 0 < rim(smoothed_rims(steps)).std() < 0.25 * rim(steps).std()


def test_a_mesh_of_too_many_faces_is_thinned_over_all_of_it() -> None:
    mesh = sheet()
    few = clustered(mesh, 10_000)
    assert 2_000 < len(few.faces) <= 10_000
    assert np.ptp(few.vertices, axis=0)[:2].min() > 0.95
    assert clustered(mesh, len(mesh.faces)) is mesh
