"""Videos whose frames are not simply shown as stored: interlaced, stretched, mirrored, raw, blank, damaged."""

import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.video import VideoReader, probe_video
from msgs_slam.formats.video_head import (
    VideoTrack,
    main_track,
    pixel_aspect,
    read_equivalent,
    read_moov,
    read_tracks,
    video_sphere,
)
from msgs_slam.formats.video_streams import AvCapture
from msgs_slam.pipelines.source.recording import VideoRecording
from tests.formats.test_formats_video import encode, hdr_signal, textured, with_matrix, woven, write_hdr

INTERLACED = [
    ("a.mp4", "libx264", {"x264-params": "tff=1"}, (320, 240)),
    ("a.mkv", "libx264", {"x264-params": "bff=1"}, (320, 240)),
    ("a.ts", "mpeg2video", {}, (320, 240)),
    ("a.mpg", "mpeg2video", {}, (320, 240)),
    ("a.dv", "dvvideo", {}, (720, 576)),
]


def put(file: av.container.OutputContainer, stream: av.VideoStream, frames: np.ndarray, first: float = 0.0) -> None:
    """Encode frames (N, H, W, 3 or 4) at 25 a second from a time on, to the end of the stream."""
    for time, picture in enumerate(frames):
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24" if picture.shape[2] == 3 else "rgba")
        frame = frame.reformat(format=stream.pix_fmt)
        frame.pts, frame.time_base = time + round(25 * first), Fraction(1, 25)
        file.mux(stream.encode(frame))
    file.mux(stream.encode())


@pytest.fixture
def without_pyav(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in an installation without the extra."""
    monkeypatch.setitem(sys.modules, "av", None)


@pytest.mark.parametrize(("name", "codec", "options", "size"), INTERLACED)
def test_interlaced_is_deinterlaced(
    tmp_path: Path, name: str, codec: str, options: dict[str, str], size: tuple[int, int]
) -> None:
    path = encode(tmp_path / name, woven(6, *size), codec, options, interlaced=True)
    reader = VideoReader(path)
    frames = list(reader)
    assert reader.interlaced
    assert [f.source_index for f in frames] == list(range(6))
    np.testing.assert_allclose(np.diff([f.timestamp for f in frames]), 0.04, atol=1e-6)
    seen = frames[3].rgb.astype(float)
    # Combed frames differ from row to row; what is there is as smooth as the pictures were.
    comb = np.abs(seen[1:-1] - (seen[:-2] + seen[2:]) / 2).mean()
    assert 0 < comb < 0.5 * np.abs(np.diff(woven(6, *size)[3].astype(float), axis=0)).mean()
    shown = textured(12, *size)[6:8].astype(float)[:, :, : seen.shape[1]]
    if seen.shape[1] == size[0]:  # pixels of DV are not square
        assert 0 < min(np.abs(seen - field).mean() for field in shown) < 12


@pytest.mark.usefixtures("without_pyav")
@pytest.mark.parametrize(("name", "codec", "options", "size"), INTERLACED)
def test_interlaced_is_named_where_it_cannot_be_read(
    tmp_path: Path, name: str, codec: str, options: dict[str, str], size: tuple[int, int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    with monkeypatch.context() as patch:
        patch.delitem(sys.modules, "av")
        path = encode(tmp_path / f"my {name}", woven(6, *size), codec, options, interlaced=True)
    with pytest.raises(InputError, match=r"is interlaced video .*ffmpeg -i '.*my a\..*' -vf yadif OUT.mp4"):
        probe_video(path)


def test_interlaced_after_progressive_is_named(tmp_path: Path) -> None:
    """In a stream that changes, OpenCV repeats its last good frame."""
    parts = [
        encode(tmp_path / "a.ts", textured(12, 320, 240), "mpeg2video").read_bytes(),
        encode(tmp_path / "b.ts", woven(12, 320, 240), "mpeg2video", interlaced=True).read_bytes(),
    ]
    (tmp_path / "c.ts").write_bytes(b"".join(parts))
    with pytest.raises(InputError, match=r"is interlaced from about frame \d+ on"):
        list(VideoReader(tmp_path / "c.ts"))


def test_separate_fields_are_named(tmp_path: Path) -> None:
    options = {"x265-params": "log-level=none:pools=1:interlace=tff"}
    path = encode(tmp_path / "a.mp4", textured(8, 320, 240)[:, ::2], "libx265", options)
    with pytest.raises(InputError, match=r"fields are stored as separate images.*-vf weave,bwdif"):
        probe_video(path)


@pytest.mark.parametrize(("codec", "container"), [("libx264", "h264"), ("libx265", "hevc")])
def test_raw_streams_are_read_at_their_rate(tmp_path: Path, codec: str, container: str) -> None:
    options = {"x265-params": "log-level=none:pools=1"} if codec == "libx265" else {}
    path = encode(tmp_path / f"a.{container}", textured(10, 320, 240), codec, options, container=container)
    assert read_moov(path) == b""
    assert video_sphere(path) == ""
    said: list[str] = []
    frames = list(VideoRecording(path).read(warn=said.append))
    np.testing.assert_allclose([f.timestamp for f in frames], np.arange(10) / 25, atol=1e-9)
    assert said == [f"a.{container} has no timestamps (a raw stream?): 25 frames a second are assumed"]


@pytest.mark.parametrize(
    "head",
    [
        b"\0\0\0\1\x67\x64\0\x1f\xff\xff\xff\xff\xff\xff\xff\xff",
        b"\0\0\0\x10ftypmp42\0\0\0\0\0\0\0\1mdat\xff\xff\xff\xff\xff\xff\xff\xff",
        b"\0\0\0\x10ftypmp42\0\0\0\0\0\0\0\1mdat\0\0\0\0\0\0\0\0",
        b"\0\0\0\x10ftypmp42\0\0\0\0\0\0\0\2moov",
        b"\0\0\0\x10ftypmp42\0\0\0\0\xff\xff\xff\xffmdat" + bytes(100),
        b"\0\0\0\1moov",
    ],
)
def test_damaged_boxes_hold_nothing(tmp_path: Path, head: bytes) -> None:
    (tmp_path / "a.mp4").write_bytes(head)
    assert read_moov(tmp_path / "a.mp4").strip(b"\0") == b""
    with pytest.raises(InputError, match="no image can be decoded"):
        probe_video(tmp_path / "a.mp4")


def test_long_boxes_are_read(tmp_path: Path) -> None:
    long = b"\0\0\0\1" + b"mdat" + (20).to_bytes(8, "big") + b"1234"
    (tmp_path / "a.mp4").write_bytes(
        b"\0\0\0\x10ftypmp42\0\0\0\0" + long + b"\0\0\0\1moov" + (19).to_bytes(8, "big") + b"abc"
    )
    assert read_moov(tmp_path / "a.mp4") == b"abc"


@pytest.mark.parametrize(("turn", "size"), [(None, (320, 240)), ((0, 1, -1, 0), (240, 320))])
def test_pixels_become_square(tmp_path: Path, turn: tuple[int, ...] | None, size: tuple[int, int]) -> None:
    """Also where the phone was held upright: what is too narrow are then the rows."""
    frames = textured(6, 320, 240)
    plain = encode(tmp_path / "plain.mp4", frames)
    narrow = encode(tmp_path / "a.mp4", frames[:, :, ::4][:, :, : 320 // 4].repeat(3, axis=2), aspect=Fraction(4, 3))
    for path in (plain, narrow) if turn else ():
        with_matrix(path, *turn)  # type: ignore[misc]
    info = probe_video(narrow)
    assert (info.width, info.height) == size
    source = VideoRecording(narrow)
    assert (source.width, source.height) == size
    said: list[str] = []
    seen, true = list(source.read(warn=said.append))[4].rgb, list(VideoReader(plain))[4].rgb
    assert seen.shape == true.shape == (size[1], size[0], 3)
    assert 0 < np.abs(seen.astype(float) - true).mean() < 12
    assert any("pixels that are not square" in s for s in said)


@pytest.mark.parametrize(
    ("wide", "high", "aspect"), [(0, 1, 1), (1, 0, 1), (1280, 1281, 1), (65535, 1, 1), (10, 11, 10 / 11)]
)
def test_only_plausible_pixels_are_believed(wide: float, high: float, aspect: float) -> None:
    assert pixel_aspect(wide, high) == aspect


def test_hdr_pixels_become_square(tmp_path: Path) -> None:
    write_hdr(tmp_path / "a.mp4", [hdr_signal(textured(1, 96, 96)[0] / 255, "HLG")] * 2, "HLG", Fraction(3, 2))
    reader = VideoReader(tmp_path / "a.mp4")
    assert (reader.tone_mapped, reader.info.width, reader.info.height) == (True, 144, 96)
    assert next(reader).rgb.shape == (96, 144, 3)


@pytest.mark.parametrize(
    ("matrix", "way"),
    [
        ((-1, 0, 0, 1), lambda f: f[:, ::-1]),
        ((1, 0, 0, -1), lambda f: f[::-1]),
        ((0, 1, 1, 0), lambda f: f.swapaxes(0, 1)),
        ((0, -1, -1, 0), lambda f: f[::-1, ::-1].swapaxes(0, 1)),
        ((-1, 0, 0, -1), lambda f: f[::-1, ::-1]),
    ],
)
@pytest.mark.parametrize("hdr", [False, True])
def test_mirrored_is_not_turned(tmp_path: Path, matrix: tuple[int, ...], way: object, hdr: bool) -> None:
    frames = textured(2, 96, 64)

    def write(path: Path) -> Path:
        if not hdr:
            return encode(path, frames)
        write_hdr(path, [hdr_signal(f / 255, "HLG") for f in frames], "HLG")
        return path

    stored = next(VideoReader(write(tmp_path / "a.mp4"))).rgb
    shown = next(VideoReader(with_matrix(write(tmp_path / "b.mp4"), *matrix))).rgb
    assert (shown == way(stored)).all()  # type: ignore[operator]


def test_frames_of_one_colour_are_left_out(tmp_path: Path) -> None:
    frames = np.concatenate([np.zeros((5, 240, 320, 3), np.uint8), textured(8, 320, 240)])
    source = VideoRecording(encode(tmp_path / "a.mp4", frames))
    said: list[str] = []
    assert [f.source_index for f in source.read(warn=said.append)] == list(range(5, 13))
    assert said == ["a.mp4: 5 frames of one flat colour (a fade, or damage) were left out"]


@pytest.mark.parametrize("pyav", [True, False])
def test_all_of_one_colour_is_refused(tmp_path: Path, pyav: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    path = encode(tmp_path / "a.mp4", np.full((4, 240, 320, 3), (0, 135, 0), np.uint8))
    if not pyav:
        monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"all 4 frames of .* are of one flat colour"):
        VideoRecording(path)


def test_a_codec_that_opencv_lacks_is_read_or_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = encode(tmp_path / "a.mp4", textured(4, 320, 240), "libsvtav1", {"svtav1-params": "lp=1"})
    assert len(list(VideoReader(path))) == 4
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match="no decoder for its codec, AV1"):
        probe_video(path)


def damaged(path: Path, frames: list[int]) -> Path:
    """Overwrite what an MP4 of one chunk holds for these frames."""
    data = bytearray(path.read_bytes())
    place = data.index(b"stsz") + 16
    sizes = [int.from_bytes(data[place + 4 * i : place + 4 * i + 4], "big") for i in range(20)]
    start = data.index(b"mdat") + 4
    for frame in frames:
        first = start + sum(sizes[:frame])
        data[first : first + sizes[frame]] = b"\xff" * sizes[frame]
    path.write_bytes(data)
    return path


def test_hdr_goes_on_after_damage_and_without_a_frame_is_explained(tmp_path: Path) -> None:
    write_hdr(tmp_path / "a.mp4", [hdr_signal(f / 255, "HLG") for f in textured(20, 96, 64)], "HLG")
    reader = VideoReader(damaged(tmp_path / "a.mp4", [7]))
    assert list(reader)[-1].timestamp == pytest.approx(1.9)
    assert (reader.tone_mapped, reader.missing_frames) == (True, 1)
    with pytest.raises(InputError, match="no image can be decoded"):
        VideoReader(damaged(tmp_path / "a.mp4", list(range(20))))


def test_what_pyav_cannot_open_has_no_frame(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"\0\0\0\x10ftypmp42\0\0\0\0" + bytes(50))
    capture = AvCapture(tmp_path / "a.mp4", "HLG")
    assert (capture.isOpened(), capture.grab()) == (False, False)
    capture.release()


def stored_over(path: Path, out: Path, first: int = 0, last: int | None = None, container: str | None = None) -> Path:
    """Copy packets of the first video stream without decoding; those before `first` are to be decoded but not shown."""
    with av.open(str(path)) as source, av.open(str(out), "w", format=container) as target:
        stream = source.streams.video[0]
        copied = target.add_stream_from_template(stream)
        for packet in list(source.demux(stream))[:last]:
            if packet.dts is None:
                continue
            packet.pts, packet.dts, packet.stream = packet.pts - first * stream.time_base.denominator // 25, (
                packet.dts - first * stream.time_base.denominator // 25), copied  # fmt: skip
            target.mux(packet)
    return out


def test_what_an_edit_list_hides_is_not_missing(tmp_path: Path) -> None:
    options = {"g": "50", "bf": "2"}
    whole = encode(tmp_path / "whole.mp4", textured(50, 96, 64), options=options)
    trimmed = stored_over(whole, tmp_path / "trimmed.mp4", first=20)
    (track,) = read_tracks(trimmed)
    assert track.samples == 50
    assert track.shown == pytest.approx(30 / 50, abs=0.05)
    said: list[str] = []
    source = VideoRecording(trimmed)
    assert abs(len(list(source.read(warn=said.append))) - 30) <= 2
    assert abs(source.expected_frames - 30) <= 2
    assert said == []


def test_a_trimmed_file_that_is_cut_off_is_truncated(tmp_path: Path) -> None:
    whole = encode(tmp_path / "whole.mp4", textured(50, 96, 64), options={"g": "50", "bf": "0"})
    trimmed = stored_over(whole, tmp_path / "trimmed.mp4", first=20)
    data = bytearray(trimmed.read_bytes())
    start, end = data.index(b"mdat"), data.index(b"moov")
    data[start + (end - start) * 7 // 10 : end - 4] = bytes(end - 4 - start - (end - start) * 7 // 10)
    trimmed.write_bytes(data)
    said: list[str] = []
    assert 0 < len(list(VideoRecording(trimmed).read(warn=said.append))) < 27
    assert any("is truncated: its header declares" in s for s in said), said


def test_joined_recordings_go_on_with_the_usual_step(tmp_path: Path) -> None:
    """Transport streams, one behind the other, each by a clock of its own."""
    parts = []
    for name, start in (("a.ts", 10.0), ("b.ts", 1.0)):
        with av.open(str(tmp_path / name), "w") as file:
            stream = file.add_stream("libx264", rate=25, options={"bf": "0"})
            stream.height, stream.width, stream.pix_fmt = 64, 96, "yuv420p"
            put(file, stream, textured(20, 96, 64), start)
        parts.append((tmp_path / name).read_bytes())
    (tmp_path / "both.ts").write_bytes(b"".join(parts))
    said: list[str] = []
    source = VideoRecording(tmp_path / "both.ts")
    times = [f.timestamp for f in source.read(warn=said.append)]
    assert len(times) == 40
    np.testing.assert_allclose(times, np.arange(40) / 25, atol=1e-3)
    assert source.expected_frames < 20_000
    assert [s for s in said if "20 of 40 timestamps were missing or went back" in s] == said


@pytest.mark.parametrize("pyav", [True, False])
def test_hdr_is_known_by_every_container(tmp_path: Path, pyav: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Matroska's own elements; an MP4 without its box, and a transport stream, by what HEVC says: with PyAV."""
    write_hdr(tmp_path / "a.mp4", [hdr_signal(f / 255, "HLG") for f in textured(3, 96, 64)], "HLG")
    stored_over(tmp_path / "a.mp4", tmp_path / "a.mkv")
    stored_over(tmp_path / "a.mp4", tmp_path / "a.ts")
    (tmp_path / "b.mp4").write_bytes((tmp_path / "a.mp4").read_bytes().replace(b"colrncl", b"freencl"))
    if not pyav:
        monkeypatch.setitem(sys.modules, "av", None)
    found = {name: VideoReader(tmp_path / name) for name in ("a.mp4", "a.mkv", "b.mp4", "a.ts")}
    by_stream = "HLG" if pyav else ""
    assert [r.hdr for r in found.values()] == ["HLG", "HLG", by_stream, by_stream]
    if pyav:
        first = [next(r).rgb.astype(float) for r in found.values()]
        assert all(np.abs(f - first[0]).mean() < 1 for f in first)


def two_tracks(path: Path, sizes: list[tuple[int, int]], default: int) -> Path:
    """Video tracks of these sizes, of which one is marked to be shown."""
    with av.open(str(path), "w") as file:
        streams = []
        for number, (width, height) in enumerate(sizes):
            stream = file.add_stream("libx264", rate=25)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.disposition = av.stream.Disposition.default if number == default else av.stream.Disposition(0)
            streams.append(stream)
        for stream in streams:
            put(file, stream, textured(8, stream.width, stream.height))
    return path


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_the_main_track_is_read_and_the_other_named(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = two_tracks(tmp_path / f"a{suffix}", [(64, 48), (96, 64)], default=1)
    said: list[str] = []
    source = VideoRecording(path)
    assert {f.rgb.shape for f in source.read(warn=said.append)} == {(64, 96, 3)}
    assert len(said) == 1
    assert "holds 2 video tracks: track 2 (96x64) is used, not track 1 (64x48)" in said[0]
    monkeypatch.setitem(sys.modules, "av", None)
    said.clear()
    source = VideoRecording(path)
    assert {f.rgb.shape for f in source.read(warn=said.append)} == {(48, 64, 3)}
    assert "track 1 (64x48) is used, not track 2 (96x64)" in said[0]
    assert "-map 0:v:1" in said[0]


def test_the_main_track_is_the_marked_one_else_the_largest() -> None:
    small, large, cover = VideoTrack(64, 48), VideoTrack(96, 64), VideoTrack(4000, 3000, samples=1)
    assert main_track([]) == main_track([small]) == main_track([large, large]) == 0
    assert main_track([small, large, cover]) == 1
    assert main_track([replace(large, is_default=False), small]) == 1


@pytest.mark.parametrize(
    ("name", "codec", "form"), [("a.mov", "prores_ks", "yuva444p10le"), ("a.webm", "libvpx-vp9", "yuva420p")]
)
def test_an_alpha_channel_is_named(tmp_path: Path, name: str, codec: str, form: str) -> None:
    with av.open(str(tmp_path / name), "w") as file:
        stream = file.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 96, 64, form
        if codec == "libvpx-vp9":
            stream.metadata["alpha_mode"] = "1"
        put(file, stream, np.insert(textured(3, 96, 64), 3, 255, axis=3))
    said: list[str] = []
    assert len(list(VideoRecording(tmp_path / name).read(warn=said.append))) == 3
    assert [s for s in said if "has an alpha channel, which is not read" in s and "--masks MASKS" in s] == said
    assert said


@pytest.mark.parametrize("keep", [40, 200, 400, 700])
def test_damaged_heads_say_nothing(tmp_path: Path, keep: int) -> None:
    """Neither a head that is cut off nor one of noise raises anything."""
    frames = textured(3, 96, 64)
    noise = np.random.default_rng(keep).integers(0, 256, 4000, dtype=np.uint8).tobytes()
    for suffix in (".mp4", ".mkv"):
        path = encode(tmp_path / f"a{suffix}", frames)
        data = path.read_bytes()
        start = data.index(b"moov") + 4 if suffix == ".mp4" else 30
        path.write_bytes(data[: start + keep] + noise)
        assert all(0 <= track.shown <= 1 for track in read_tracks(path))


def test_the_lens_of_a_phone_is_read_from_its_metadata(tmp_path: Path) -> None:
    path, key = tmp_path / "phone.mov", "com.apple.quicktime.camera.focal_length.35mm_equivalent"
    with av.open(path, "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata.update({"com.apple.quicktime.model": "phone", key: "28"})
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height = 64, 48
        for picture in np.random.default_rng(0).integers(0, 255, (2, 48, 64, 3), np.uint8):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    assert read_equivalent(path) == 28.0
    assert VideoRecording(path).exif_focal() == pytest.approx(28 / 43.267 * 80, rel=1e-4)
    data = path.read_bytes()
    place = data.index(b"\0\0\0\x01\0\0\0\0" + b"28")
    for value, wanted in ((b"99", 99.0), (b"\0\0", None), (b"xy", None)):
        path.write_bytes(data[: place + 8] + value + data[place + 10 :])
        assert read_equivalent(path) == wanted
    path.write_bytes(data[:place] + b"\0\0\0\x16" + b"\0\0\0\0" + b"\0\x1a" + data[place + 10 :])
    assert read_equivalent(path) == 26.0
    path.write_bytes(data.replace(key.encode(), key.encode()[::-1]))
    assert read_equivalent(path) is None
    assert VideoRecording(path).exif_focal() is None
