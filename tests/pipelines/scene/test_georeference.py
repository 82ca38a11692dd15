"""Worlds laid onto the Earth: against another library's numbers, with outliers, and where it cannot be."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.gps import enu_from_geodetic, photo_places, read_track
from msgs_slam.formats.image_folder import list_images
from msgs_slam.pipelines.config import ExportConfig
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.gps import georeference
from msgs_slam.pipelines.scene.world import WORLD

OracleRun = Callable[..., RunFolder]
ORIGIN = np.array([55.698, 13.195, 37.0])


def places_of(enu: NDArray) -> NDArray:
    """Latitude, longitude, altitude of metres east, north, up of `ORIGIN`, by pycolmap."""
    lat, lon, alt = ORIGIN
    return np.asarray(pycolmap.GPSTransform().enu_to_ellipsoid(enu, lat, lon, alt))


def walk(count: int = 40) -> NDArray:
    t = np.linspace(0, 1, count)
    return np.stack([60 * t, 15 * np.sin(5 * t), 1.6 + 0 * t], axis=1)


def test_metres_agree_with_another_library() -> None:
    enu = np.array([[0.0, 0, 0], [120.0, -300, 15], [-2000.0, 900, -40]])
    np.testing.assert_allclose(enu_from_geodetic(places_of(enu), ORIGIN), enu, atol=1e-3)


@pytest.mark.parametrize("metric", [False, True])
def test_a_walk_finds_its_place_and_one_wrong_fix_does_not_bend_it(metric: bool) -> None:
    rng = np.random.default_rng(0)
    true = walk()
    places = places_of(true + rng.normal(size=true.shape) * (1.0, 1.0, 3.0))
    turn = np.deg2rad(70)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    world_from_enu = Similarity(1.0 if metric else 0.13, rotation, np.array([4.0, 5, 0]))
    centers = world_from_enu.apply(true)
    places[3:5] = np.nan
    clean = georeference(centers, places, metric)
    wrong = places.copy()
    wrong[20, 0] += 500 / 111_000
    bent = georeference(centers, wrong, metric)
    assert (clean[1].fixes, bent[1].fixes) == (38, 38)
    assert bent[1].used < 38
    for move, found in (clean, bent):
        assert 0.6 < found.residual < 1.4
        shift = enu_from_geodetic(np.array([found.origin]), ORIGIN)[0]
        error = move.apply(centers)[:, :2] + shift[:2] - true[:, :2]
        assert 0 < np.abs(error).max() < 1.0, "a metre of noise, forty fixes"
    scale = world_from_enu.scale * clean[0].scale
    assert scale == pytest.approx(1, abs=0 if metric else 4 * clean[1].scale_sd + 1e-9)
    assert clean[1].scale_sd == 0 if metric else 0 < clean[1].scale_sd < 0.03


def test_what_gps_cannot_tell_is_not_claimed() -> None:
    true = walk()
    places = places_of(true)
    few = places.copy()
    few[3:] = np.nan
    assert "3 frames" in str(georeference(true, few, True))
    rng = np.random.default_rng(1)
    small = 0.02 * true
    noisy = places_of(small + rng.normal(size=true.shape) * 5)
    assert "too little" in str(georeference(small, noisy, True))


def test_tracks_are_read_and_damage_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Time,Lat,Lon,Alt\n2,55.2,13.2,31\n0,55.0,13.0,30\n1,55.1,13.1,\n")
    track = read_track(tmp_path / "a.csv")
    np.testing.assert_allclose(track.at(np.array([0.5, 9.0]), 2.0)[0, :2], [55.05, 13.05])
    assert np.isnan(track.at(np.array([9.0]), 2.0)).all()
    points = "".join(
        f'<trkpt lat="55.{i}" lon="13.{i}"><ele>3{i}</ele><time>2026-11-22T10:00:0{i}Z</time></trkpt>' for i in range(3)
    )
    (tmp_path / "b.gpx").write_text(f'<?xml version="1.0"?><gpx><trk><trkseg>{points}</trkseg></trk></gpx>')
    other = read_track(tmp_path / "b.gpx")
    np.testing.assert_allclose(other.degrees, track.degrees)
    np.testing.assert_allclose(np.diff(other.times), 1)
    for text in (
        "hello",
        "time,lat,lon\n1,95,3\n2,1,1\n",
        "time,lat,lon\n1,5,3\n",
        "<gpx></gpx>",
        "time,lat,lon\nx,y,z",
    ):
        (tmp_path / "bad.csv").write_text(text)
        with pytest.raises(InputError, match="GPS track"):
            read_track(tmp_path / "bad.csv")


@pytest.mark.parametrize(
    ("name", "text", "altitude"),
    [
        ("geo.txt", "EPSG:4326\nIMG_1.jpg 13.0 55.0 30 0 0 0\nIMG_2.jpg 13.1 55.1 31 0 0 0\n", 31),
        ("a.csv", "filename,latitude,longitude,altitude\nIMG_1.JPG,55,13,30\nIMG_2.JPG,55.1,13.1,31\n", 31),
        ("b.csv", "SourceFile;GPSLatitude;GPSLongitude\n./x/IMG_1.jpg;55,0;13,0\n./x/IMG_2.jpg;55,1;13,1\n", np.nan),
        ("c.txt", "#CoordinateSystem: WGS84\n#Label,X/Longitude,Y/Latitude,Z/Altitude\nIMG_1,13,55,30\n"
         "IMG_2,13.1,55.1,31", 31),
    ],
)  # fmt: skip
def test_a_table_of_images_is_read_by_their_names(name: str, text: str, altitude: float, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    found = read_track(tmp_path / name).of(["img_2.jpg", "IMG_3.jpg"])
    np.testing.assert_allclose(found, [[55.1, 13.1, altitude], [np.nan] * 3])


def test_a_table_in_metres_is_refused(tmp_path: Path) -> None:
    (tmp_path / "geo.txt").write_text("WGS84 UTM 32N\nIMG_1.jpg 500000 5300000 30\nIMG_2.jpg 500001 5300001 31\n")
    with pytest.raises(InputError, match="convert it to EPSG:4326"):
        read_track(tmp_path / "geo.txt")


@pytest.mark.parametrize("longitude", ["longitude", "longtitude "])
def test_a_drones_subtitles_are_a_track(longitude: str, tmp_path: Path) -> None:
    blocks = (
        f"{i + 1}\n00:01:0{i},500 --> 00:01:0{i + 1},500\n<font>FrameCnt: {i}\n[iso: 100] [latitude: 55.{i}] "
        f"[{longitude}: 13.{i}] [rel_alt: 2.0 abs_alt: 3{i}.0]</font>\n\n"
        for i in range(3)
    )
    (tmp_path / "DJI_0001.SRT").write_text("".join(blocks))
    track = read_track(tmp_path / "DJI_0001.SRT")
    assert track.times.tolist() == [60.5, 61.5, 62.5]
    np.testing.assert_allclose(track.degrees, [[55, 13], [55.1, 13.1], [55.2, 13.2]])
    assert track.altitude.tolist() == [30, 31, 32]


def test_a_track_may_cross_the_date_line(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,lat,lon\n0,10,179.9\n2,10,-179.9\n4,10,-179.5\n")
    found = read_track(tmp_path / "a.csv").at(np.array([0.5, 1.5, 3.0]), 2.0)[:, 1]
    np.testing.assert_allclose(found, [179.95, -179.95, -179.7])


def test_waypoints_are_a_track_where_there_is_no_other(tmp_path: Path) -> None:
    (tmp_path / "a.gpx").write_bytes(_gpx(_point(1) + _point(2)).replace(b"trkpt", b"wpt"))
    assert read_track(tmp_path / "a.gpx").degrees[:, 0].tolist() == [51, 52]


def _gpx(points: str, head: str = "") -> bytes:
    return f"{head}<gpx xmlns='http://www.topografix.com/GPX/1/1'><trk><trkseg>{points}</trkseg></trk></gpx>".encode()


def _point(i: int) -> str:
    return f'<trkpt lon="1{i}" lat="5{i}"><time>2026-11-22T10:00:0{i}Z</time></trkpt>'


@pytest.mark.parametrize(
    ("content", "latitudes", "lost"),
    [
        (_gpx('<trkpt lat="9" lon="9"/>' + _point(1) + _point(2)), [51, 52], 0),
        (_gpx('<trkpt lat="9" lon="9"></trkpt>' + _point(2) + _point(1)), [51, 52], 0),
        (
            _gpx(_point(1) + _point(2) + '<trkpt lat="99" lon="9"><time>2026-11-22T10:00:09Z</time></trkpt>'),
            [51, 52],
            1,
        ),
        (_gpx(_point(1) + _point(2) + _point(3))[:-60], [51, 52], 0),
        (_gpx(_point(1) + _point(2), "<?xml version='1.0' encoding='UTF-16'?>").decode().encode("utf-16"), [51, 52], 0),
        (b"\xef\xbb\xbftime;lat;lon\r\n1;51;1\r\n2;nan;1\r\n2;;\r\n3;52;1\r\n3;52;1\r\n4;53;1\r\n", [51, 52, 53], 2),
    ],
    ids=["point without time", "empty point", "out of range", "cut short", "UTF-16", "CSV"],
)
def test_rows_that_are_no_fix_cost_only_themselves(
    content: bytes, latitudes: list[int], lost: int, tmp_path: Path
) -> None:
    (tmp_path / "a.gpx").write_bytes(content)
    track = read_track(tmp_path / "a.gpx")
    assert (track.degrees[:, 0].tolist(), track.lost) == (latitudes, lost)
    assert (np.diff(track.times) > 0).all()


def test_a_track_does_not_grow_when_it_is_read(tmp_path: Path) -> None:
    """Neither by entities, nor in time with the square of its points, nor in depth."""
    entities = "".join(f"<!ENTITY a{i} '{f'&a{i - 1};' * 10}'>" for i in range(1, 11))
    bomb = _gpx("<trkpt lat='1' lon='1'><time>&a10;</time></trkpt>", f"<!DOCTYPE gpx [<!ENTITY a0 'ha'>{entities}]>")
    secret = _gpx(_point(1) + "&s;" + _point(2), f"<!DOCTYPE gpx [<!ENTITY s SYSTEM 'file://{tmp_path}/s'>]>")
    for content in (bomb, secret, b"<gpx>" + b"<trkpt >" * 100_000, _gpx("<trkpt lat='1' lon='1'></trkpt>" * 100_000)):
        (tmp_path / "a.gpx").write_bytes(content)
        with pytest.raises(InputError, match="GPS track"):
            read_track(tmp_path / "a.gpx")


def test_photos_tell_their_places(shared_data: Path) -> None:
    photos = list_images(shared_data / "gps_photos" / "images")
    places = photo_places([*photos, None])
    assert np.isfinite(places[:-1]).all()
    assert np.isnan(places[-1]).all()
    enu = enu_from_geodetic(places[:-1], places[0])
    assert 20 < np.linalg.norm(enu, axis=1).max() < 1000


def test_files_of_a_run_with_a_track_lie_on_the_earth(oracle_run: OracleRun, tmp_path: Path) -> None:
    run = oracle_run(metric=False, video=True)
    outcome = load_outcome(run)
    # The room is 3 m wide: a track that is good to a millimetre, of a walk twenty times as long.
    enu = 20 * outcome.trajectory.centers
    rows = [
        f"{t},{p[0]:.9f},{p[1]:.9f},{p[2]:.4f}"
        for t, p in zip(outcome.trajectory.timestamps, places_of(enu), strict=True)
    ]
    (tmp_path / "track.csv").write_text("\n".join(["time,lat,lon,alt", *rows]))
    export_run(run, tmp_path / "out", "tum", settings=ExportConfig(gps=str(tmp_path / "track.csv")))
    world = WORLD.read(tmp_path / "out" / "world.json")
    assert world.exported_from_run.scale == pytest.approx(20, rel=1e-3)
    positions = np.loadtxt(tmp_path / "out" / "trajectory.txt")[:, 1:4]
    shift = enu_from_geodetic(np.array([world.earth.origin]), ORIGIN)[0]
    # Up is good to a third of a degree: centimetres over the walk's height.
    assert np.abs(positions[:, :2] + shift[:2] - enu[:, :2]).max() < 0.3
    assert world.has_floor
    assert abs(np.median(positions[:, 2]) - np.median(enu[:, 2])) < 1.0
