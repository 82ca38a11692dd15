"""A lighter mesh, its charts, and a texture painted from views whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from ball import CAMERA, RADIUS, see_ball, seen_points
from numpy.typing import NDArray

from msgs_slam.formats.ply import MeshArrays
from msgs_slam.pipelines.export import texture
from msgs_slam.pipelines.export.light import SHARE, simplified
from msgs_slam.pipelines.export.surface import filled
from msgs_slam.pipelines.export.texture import Atlas, Shot, owners, paint_texture, texels_wanted, unwrapped
from msgs_slam.pipelines.geometry.posed_depth import PosedDepth
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.system.raster import draw_faces
from msgs_slam.pipelines.system.threads import get_threads, set_threads
from msgs_slam.pipelines.types import VOID, Intrinsics

FULL = CAMERA.resized(320, 240)


def waves(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """The true colour of places: a pattern finer than the lighter mesh's triangles."""
    x, y, z = np.moveaxis(points, -1, 0)
    return (0.5 + 0.4 * np.stack([np.sin(40 * x), np.sin(40 * y), np.sin(40 * z)], axis=-1)).astype(np.float32)


def picture(angle: float) -> NDArray[np.float32]:
    view = see_ball(angle, FULL)
    return np.where(view.depth[..., None] > 0, waves(seen_points(view)), 0)


def shot(angle: float, sharpness: float = 1.0, photo: NDArray[np.float32] | None = None) -> Shot:
    shown = picture(angle) if photo is None else photo
    return Shot(see_ball(angle), FULL, sharpness, lambda: shown)


SHOTS = [shot(a) for a in np.arange(12) * np.pi / 6]


@pytest.fixture(scope="module")
def fine() -> MeshArrays:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    labels = np.where(ball.vertices[:, 0] < 0, 3, VOID).astype(np.uint8)
    grey = np.full((len(ball.vertices), 3), 128, np.uint8)
    return MeshArrays(ball.vertices.astype(np.float32), ball.faces.astype(np.int32), grey, labels)


@pytest.fixture(scope="module")
def atlas(fine: MeshArrays) -> Atlas:
    light = simplified(fine, round(SHARE * len(fine.faces)))
    return unwrapped(light, texels_wanted(light.vertices, light.faces, SHOTS), 4096)


@pytest.fixture(scope="module")
def painted(atlas: Atlas) -> NDArray[np.uint8]:
    return paint_texture(atlas, SHOTS, SilentProgress())


def cross(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def places(atlas: Atlas) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Texels well inside of faces, and where on the mesh they lie."""
    owner = owners(atlas)
    rows, columns = np.nonzero(owner >= 0)
    corners = atlas.corner_faces[owner[rows, columns]]
    a, b, c = np.moveaxis(atlas.corners[corners], 1, 0)
    xy = np.stack([columns, rows], 1) + 0.5
    twice = cross(b - a, c - a)
    shares = np.stack([cross(b - xy, c - xy), cross(c - xy, a - xy), cross(a - xy, b - xy)], 1) / twice[:, None]
    points = np.einsum("nk,nkd->nd", shares, atlas.mesh.vertices[atlas.corner_vertex[corners]].astype(np.float64))
    inside = np.zeros(owner.shape, bool)
    inside[rows, columns] = (shares >= 0).all(1)
    return inside, points[(shares >= 0).all(1)]


def test_a_tenth_of_the_faces_keeps_shape_and_labels(fine: MeshArrays) -> None:
    light = simplified(fine, round(SHARE * len(fine.faces)))
    assert 0.08 < len(light.faces) / len(fine.faces) <= 0.1
    off = np.abs(np.linalg.norm(light.vertices, axis=1) - RADIUS)
    assert 0 < off.max() < 0.01 * RADIUS
    clear = np.abs(light.vertices[:, 0]) > 0.05
    assert ((light.labels == 3) == (light.vertices[:, 0] < 0))[clear].all()
    assert trimesh.Trimesh(light.vertices, light.faces, process=False).is_watertight


def test_charts_do_not_overlap_and_keep_the_faces(atlas: Atlas) -> None:
    np.testing.assert_array_equal(atlas.corner_vertex[atlas.corner_faces], atlas.mesh.faces)
    a, b, c = np.moveaxis(atlas.corners[atlas.corner_faces], 1, 0)
    flat = np.abs(cross(b - a, c - a)) / 2
    # Where charts lay over each other, faces would own fewer texels than they have area.
    assert np.bincount(owners(atlas)[places(atlas)[0]]).sum() == pytest.approx(flat.sum(), rel=0.02)
    assert atlas.corners.min() >= 0
    assert (atlas.corners <= (atlas.width, atlas.height)).all()


def test_texels_have_the_colours_of_their_places(atlas: Atlas, painted: NDArray[np.uint8]) -> None:
    inside, points = places(atlas)
    seen = np.abs(points[:, 1]) < 0.8 * RADIUS  # the poles are not
    error = np.abs(painted[inside] / 255 - waves(points / np.linalg.norm(points, axis=1, keepdims=True) * RADIUS))[seen]
    assert 0 < error.mean() < 0.02
    assert np.percentile(error, 99) < 0.1


def test_what_nobody_sees_has_the_vertices_colours(atlas: Atlas) -> None:
    alone = paint_texture(atlas, SHOTS[:1], SilentProgress())
    inside, points = places(atlas)
    behind = points @ SHOTS[0].depth_view.cam_from_world[2, :3] > 0.1
    assert behind.any()
    assert (alone[inside][behind] == 128).all()
    assert (alone[inside][~behind] != 128).any(axis=1).mean() > 0.6


def test_no_texel_is_left_black(atlas: Atlas) -> None:
    """What lies beside charts goes on with their colours, for small pictures of the texture."""
    nothing = replace(SHOTS[0], hidden=np.ones((FULL.height, FULL.width), bool))
    assert (owners(atlas) < 0).any()
    assert (paint_texture(atlas, [nothing], SilentProgress()) == 128).all()


def test_blurred_and_hidden_views_count_less(atlas: Atlas) -> None:
    dark, light = np.zeros((FULL.height, FULL.width, 3), np.float32), np.ones((FULL.height, FULL.width, 3), np.float32)
    views = [shot(0.0, photo=dark), shot(0.0, sharpness=0.5, photo=light), shot(np.pi, photo=light)]
    both = paint_texture(atlas, views, SilentProgress())
    inside, points = places(atlas)
    ahead = points @ views[0].depth_view.cam_from_world[2, :3] < -0.5 * RADIUS
    share = 0.5**texture.POWER / (1 + 0.5**texture.POWER)
    np.testing.assert_allclose(both[inside][ahead], round(255 * share), atol=1)


def test_a_map_that_is_not_the_mesh_paints_up_to_its_rims(atlas: Atlas) -> None:
    """Its depth is off by twentieths, and knows nothing of some pixels; what is seen of the mesh decides."""
    view = SHOTS[0].depth_view
    depth, trust = view.depth * np.float32(1.05), view.trust.copy()
    trust[:, 75:85] = 0
    other = paint_texture(
        atlas, [replace(SHOTS[0], depth_view=replace(view, depth=depth, trust=trust))], SilentProgress()
    )
    np.testing.assert_array_equal(other, paint_texture(atlas, SHOTS[:1], SilentProgress()))


def test_faces_in_a_picture_meet_without_gaps_and_may_reach_behind_the_camera() -> None:
    """A floor of two triangles from behind the camera to a wall of many, by the true depth of both."""
    side = 40
    y, x = np.mgrid[:side, :side] / (side - 1)
    wall = np.stack([6 * x - 3, 4 * y - 3, np.full((side, side), 4.0)], axis=-1).reshape(-1, 3)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + side], 1), np.stack([a + 1, a + side + 1, a + side], 1)])
    floor = np.array([[-3, 1, -5], [3, 1, -5], [3, 1, 4], [-3, 1, 4.0]])
    points = np.concatenate([wall, floor])
    faces = np.concatenate([faces, len(wall) + np.array([[0, 1, 2], [0, 2, 3]])]).astype(np.int32)
    drawn = draw_faces(points, faces, np.eye(4), CAMERA)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    slope = (v - CAMERA.cy) / CAMERA.fy
    expected = np.where(slope > 0.25, 1 / np.maximum(slope, 0.25), 4.0)
    np.testing.assert_allclose(drawn.depth, expected, rtol=1e-5)
    place = np.einsum("hwk,hwkc->hwc", drawn.shares, points[faces[drawn.face]])
    np.testing.assert_allclose(place[..., 0], (u - CAMERA.cx) / CAMERA.fx * expected, atol=1e-4)
    nothing = draw_faces(points - np.array([0, 0, 20]), faces, np.eye(4), CAMERA)
    assert (nothing.face == -1).all()
    assert (nothing.depth == 0).all()


def test_an_occluder_in_front_is_not_painted_on(atlas: Atlas) -> None:
    """A board before one camera, which its depth knows of, leaves no trace."""
    view, full = see_ball(0.0), picture(0.0)
    view.depth[40:80, 60:100], full[80:160, 120:200] = 1.0, (1.0, 0.0, 1.0)
    board = Shot(replace(view, trust=(view.depth > 0).astype(np.float32)), FULL, 1.0, lambda: full)
    with_board = paint_texture(atlas, [board], SilentProgress())
    assert not ((with_board[..., 0] > 240) & (with_board[..., 1] < 20)).any()


def test_threads_do_not_change_a_byte(atlas: Atlas, painted: NDArray[np.uint8]) -> None:
    before = get_threads()
    try:
        set_threads(1 if before > 1 else 2)
        again = unwrapped(atlas.mesh, texels_wanted(atlas.mesh.vertices, atlas.mesh.faces, SHOTS), 4096)
        assert again.corners.tobytes() == atlas.corners.tobytes()
        assert paint_texture(again, SHOTS, SilentProgress()).tobytes() == painted.tobytes()
    finally:
        set_threads(before)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_charts_do_not_depend_on_the_unit(atlas: Atlas, unit: float) -> None:
    other = unwrapped(replace(atlas.mesh, vertices=atlas.mesh.vertices * np.float32(unit)), 150 / unit, 4096)
    same = unwrapped(atlas.mesh, 150, 4096)
    assert (other.width, other.height) == pytest.approx((same.width, same.height), rel=0.02)
    assert len(np.unique(owners(other))) == len(np.unique(owners(same))) > 0.9 * len(atlas.mesh.faces)


def test_a_mesh_without_any_area_has_a_texture_too() -> None:
    """Of six points on a line: nothing to see, and nothing that ends an export."""
    points = np.arange(21, dtype=np.float32).reshape(7, 3) * [1, 0, 0]
    faces = np.arange(5, dtype=np.int32)[:, None] + np.arange(3, dtype=np.int32)
    line = MeshArrays(points.astype(np.float32), faces, np.full((7, 3), 9, np.uint8), np.zeros(7, np.uint8))
    flat = unwrapped(simplified(line, 1), 100.0, 4096)
    assert paint_texture(flat, SHOTS[:1], SilentProgress()).shape == (flat.height, flat.width, 3)


def test_the_side_is_kept(atlas: Atlas) -> None:
    small = unwrapped(atlas.mesh, 1e4, 200)
    assert 150 < max(small.width, small.height) <= 200


def sheet(side: int = 60) -> tuple[MeshArrays, PosedDepth]:
    """A square of triangles at depth 2 with a slit, a hole as wide as five edges and an open bay, and another square
    far behind it; and the depth that the camera sees: between the bars, in the hole, it sees the second one."""
    y, x = np.mgrid[:side, :side]
    number = (y * side + x).astype(np.int32)
    a, b, c, d = (number[r, s].ravel() for r, s in (np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]))
    near = np.stack([x / side - 0.5, y / side - 0.5, np.full((side, side), 2.0)], axis=-1).reshape(-1, 3)
    row, column = a // side, a % side
    slit, hole = (row == 20) & (abs(column - 30) < 15), (abs(row - 40) < 3) & (abs(column - 40) < 3)
    whole = ~(slit | hole | ((row > 50) & (abs(column - 10) < 2)))
    faces = np.concatenate([np.stack(f, 1)[whole] for f in ((a, c, b), (b, c, d))])
    points = np.concatenate([near, near + np.array([0, 0, 1])]).astype(np.float32)
    behind = np.concatenate([np.stack((a, c, b), 1), np.stack((b, c, d), 1)]) + len(near)
    mesh = MeshArrays(
        points, np.concatenate([faces, behind]), np.zeros((len(points), 3), np.uint8), np.zeros(len(points), np.uint8)
    )
    through = (abs(y - 40.5) < 3) & (abs(x - 40.5) < 3)
    depth = np.where(through, 3.0, 2.0).astype(np.float32)
    camera = Intrinsics(side, side, 2.0 * side, 2.0 * side, side / 2, side / 2)
    return mesh, PosedDepth(camera, np.eye(4), depth, np.ones_like(depth))


def area(mesh: MeshArrays, faces: NDArray[np.int32]) -> float:
    """Of these faces, in squares of the sheet."""
    a, b, c = np.moveaxis(mesh.vertices[faces].astype(float), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 * 60**2)


def test_slits_and_bays_are_closed_and_what_a_view_looks_through_stays_open() -> None:
    mesh, view = sheet()
    new = filled(mesh, [view]).faces[len(mesh.faces) :]
    middle = mesh.vertices[new].mean(axis=1) * 60 + 30
    assert (mesh.vertices[new][..., 2] == 2).all()
    assert not (abs(middle[:, :2] - 40.5) < 3).all(axis=1).any()
    assert 0.9 * (29 + 3 * 8) < area(mesh, new) < 1.1 * (29 + 3 * 8)

    # What the view sees there is not part of the mesh: nothing shows that the hole is one.
    near = np.s_[:3600]
    alone = MeshArrays(
        mesh.vertices[near], mesh.faces[mesh.faces.max(axis=1) < 3600], mesh.colors[near], mesh.labels[near]
    )
    assert area(mesh, filled(alone, [view]).faces[len(alone.faces) :]) > area(mesh, new) + 20
    # Nobody looks there.
    assert len(filled(mesh, []).faces) == len(mesh.faces)
