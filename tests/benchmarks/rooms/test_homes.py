"""Homes hang together, and the walks through them are possible ones."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.benchmarks.rooms.furniture import Catalogue
from tests.benchmarks.rooms.home import Home, Place, build_home, plan
from tests.benchmarks.rooms.surfaces import THICK

NO_FURNITURE = Catalogue([], np.zeros((0, 256, 256, 3), np.uint8))


def test_rooms_of_a_plan_stand_beside_each_other_and_share_their_doors() -> None:
    kinds = set()
    for seed in range(40):
        places = plan(np.random.default_rng(seed))
        kinds |= {p.kind for p in places}
        assert 3 <= len(places) <= 8
        for n, place in enumerate(places):
            low, high = place.bounds()
            for other in places[:n]:
                a, b = other.bounds()
                assert max(low[0] - b[0], a[0] - high[0], low[2] - b[2], a[2] - high[2]) > THICK / 2 - 1e-6
            if place.parent >= 0:
                own = middles(place)[0]
                assert min(np.linalg.norm(own - m) for m in middles(places[place.parent])) == pytest.approx(THICK)
                assert np.linalg.norm(place.door - own) == pytest.approx(THICK / 2)
    assert kinds == {"home", "corridor", "stairs"}


def test_a_stair_goes_up_to_the_room_behind_it() -> None:
    plans = (plan(np.random.default_rng(seed)) for seed in range(60))
    places = next(p for p in plans if any(q.kind == "stairs" for q in p))
    number = next(n for n, p in enumerate(places) if p.kind == "stairs")
    stairs, upper = places[number], next(p for p in places if p.parent == number)
    levels = stairs.level(np.full(200, 0.5), np.linspace(0, stairs.size[1], 200))
    assert levels[0] == 0
    assert levels[-1] == upper.frame[1, 3] > 2
    assert 0 <= np.diff(levels).min() < np.diff(levels).max() < 0.2


def middles(place: Place) -> list[np.ndarray]:
    """Feet of the middles of a room's passages, in the world."""
    wide, deep, _ = place.size
    corners = np.array([(0, 0), (wide, 0), (wide, deep), (0, deep)])
    ways = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
    out = []
    for corner, way, holes in zip(corners, ways, place.doors, strict=True):
        for h in holes:
            x, z = corner + way * (h.left + h.right) / 2
            out.append((place.frame @ [x, h.low, z, 1])[:3])
    return out


@pytest.fixture(scope="module")
def home() -> Home:
    return build_home(3, NO_FURNITURE)[0]


def test_a_walk_goes_through_rooms_without_touching_a_thing_or_jumping(home: Home, tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    from tests.benchmarks.rooms import stroll
    from tests.benchmarks.rooms.light import LitRoom

    lit = LitRoom(home.surfaces)
    walk = stroll.stroll_through(home, lit, np.random.default_rng(0))
    assert walk is not None
    assert stroll.LEAST <= walk.seconds <= stroll.MOST
    poses = walk.poses(np.arange(0, walk.seconds, 0.1))
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert 0 < steps.max() < 0.3
    turns = np.arccos(np.clip((poses[1:, :3, 2] * poses[:-1, :3, 2]).sum(1), -1, 1))
    assert 60 < np.degrees(turns.max()) / 0.1 < 150
    sides = np.concatenate([np.eye(3), -np.eye(3)])
    assert min(lit.distance(p, sides).min() for p in poses[:, :3, 3]) > 0.1
    passed = [p.bounds() for p in home.places]
    inside = [((b[0] < poses[:, :3, 3]) & (poses[:, :3, 3] < b[1])).all(1).any() for b in passed]
    assert all(inside[n] for n in walk.rooms)
    check_film(lit, walk, tmp_path)


def check_film(lit: object, walk: object, folder: Path) -> None:
    """What a walk leaves: views half a metre beside its path, of which the path saw some part."""
    from tests.benchmarks.rooms.film import ASIDE, Camera, film

    film(lit, walk, Camera(48, 64, 50.0, 2, 0.2, 0.3), folder / "one", np.random.default_rng(0))  # type: ignore[arg-type]
    path = np.loadtxt(folder / "one" / "traj.txt").reshape(-1, 4, 4)
    beside = np.loadtxt(folder / "one" / "beside" / "poses.txt").reshape(-1, 4, 4)
    assert len(beside) > 5
    for k, pose in enumerate(beside):
        rgba = cv2.imread(str(folder / "one" / "beside" / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert rgba.shape == (64, 48, 4)
        assert set(np.unique(rgba[..., 3])) <= {0, 255}
        away = np.linalg.norm(path[:, :3, 3] - pose[:3, 3], axis=1)
        assert 0.02 < away.min() < ASIDE + 0.01
    assert len(list((folder / "one" / "depth").glob("*.png"))) == -(-len(path) // 6)


def test_a_room_is_shown_as_the_network_of_shapes_learns_it() -> None:
    """Floor and walls are where the channels have them; a depth that is made wrong stays one."""
    pytest.importorskip("embreex")
    from msgs_slam.pipelines.labels.shape import CHANNELS, NAMES
    from tests.benchmarks.names_by_shape import examples, see_room

    views = see_room(50_000, NO_FURNITURE)
    assert views is not None
    found = examples(views, 50_000)
    channels, names = found["channels"].astype(np.float32), found["names"]
    assert channels.shape[:2] == (len(names), CHANNELS)
    assert np.isfinite(channels).all()
    known = channels[:, 1] > 0
    for name, slope in (("floor", 1.0), ("wall", 0.0), ("ceiling", -1.0)):
        there = known & (names == NAMES.index(name))
        if there.sum() > 500:
            assert np.median(channels[:, 6][there]) == pytest.approx(slope, abs=0.05)
    on_floor = known & (names == NAMES.index("floor"))
    assert np.median(np.abs(channels[:, 4][on_floor] + 1)) < 0.05
