"""Real, odd and broken videos; the repair of time stamps against a known clock; videos for browsers by each codec."""

import itertools
import os
import struct
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.video import Clock, VideoReader, probe_video
from msgs_slam.formats.video_streams import H264, MPEG4, VP9, best_codec, write_browser_video, write_video

REPO = Path(__file__).resolve().parents[2]


def textured(count: int, width: int, height: int, step: int = 3) -> np.ndarray:
    """(count, height, width, 3) uint8: blurred noise that moves to the left by `step` pixels a frame."""
    noise = np.random.default_rng(0).uniform(0, 255, (height, width + count * step, 3))
    smooth = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    return np.stack([smooth[:, i * step : i * step + width] for i in range(count)])


def woven(count: int, width: int, height: int) -> np.ndarray:
    """Interlaced frames of `textured`: their even rows are its frames 0, 2, 4..., their odd rows 1, 3, 5..."""
    fields = textured(2 * count, width, height)
    frames = fields[::2].copy()
    frames[:, 1::2] = fields[1::2, 1::2]
    return frames


def encode(
    path: Path, frames: np.ndarray, codec: str = "libx264", options: dict[str, str] | None = None,
    interlaced: bool = False, aspect: Fraction | None = None, container: str | None = None,
) -> Path:  # fmt: skip
    """25 frames a second by PyAV; `aspect` is that of a pixel, `interlaced` sets the codec's flags for it."""
    with av.open(str(path), "w", format=container) as file:
        stream = file.add_stream(codec, rate=25, options=options or {})
        stream.height, stream.width, stream.pix_fmt = *frames[0].shape[:2], "yuv420p"
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        if interlaced:
            stream.codec_context.flags |= 1 << 18 | 1 << 29
        for time, rgb in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24").reformat(format="yuv420p")
            frame.pts, frame.time_base = time, Fraction(1, 25)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return path


def with_matrix(path: Path, a: int, b: int, c: int, d: int) -> Path:
    """Write a display matrix into the track header of an MP4."""
    data = bytearray(path.read_bytes())
    place = data.index(b"tkhd") + 4 + 40
    data[place : place + 36] = struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    return path


@pytest.fixture(scope="module")
def counted_video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """40 frames of 96x64 at 25/s; frame i is (red 6 i, green 0, blue 240 - 6 i) with a white top-left corner."""
    path = tmp_path_factory.mktemp("video") / "counted.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25.0, (96, 64))
    for i in range(40):
        bgr = np.full((64, 96, 3), (240 - 6 * i, 0, 6 * i), np.uint8)
        bgr[:16, :24] = 255
        writer.write(bgr)
    writer.release()
    return path


def test_frames_come_as_rgb_in_order_with_times(counted_video: Path) -> None:
    frames = list(VideoReader(counted_video))
    assert [f.source_index for f in frames] == list(range(40))
    np.testing.assert_allclose([f.timestamp for f in frames], np.arange(40) / 25, atol=1e-6)
    assert frames[0].rgb.shape == (64, 96, 3)
    assert frames[0].rgb.dtype == np.uint8
    middle = np.array([f.rgb[40, 60] for f in frames], float)
    np.testing.assert_allclose(middle[:, 0], 6.0 * np.arange(40), atol=12)
    np.testing.assert_allclose(middle[:, 2], 240 - 6.0 * np.arange(40), atol=12)
    assert all(f.rgb[4, 4].min() > 200 and f.rgb[60, 90].min() < 60 for f in frames)
    info = probe_video(counted_video)
    assert (info.width, info.height, info.frame_count_claimed, info.fps) == (96, 64, 40, pytest.approx(25))


@pytest.mark.parametrize("wanted", [{3, 17, 39}, lambda i: i in (3, 17, 39), range(3, 40, 18)])
def test_wanted_frames_are_the_same_pictures(counted_video: Path, wanted: object) -> None:
    every = list(VideoReader(counted_video))
    reader = VideoReader(counted_video, wanted)  # type: ignore[arg-type]
    some = list(reader)
    assert len(some) == len(range(3, 40, 18)) if isinstance(wanted, range) else 3
    assert all(
        (f.rgb == every[f.source_index].rgb).all() and f.timestamp == every[f.source_index].timestamp for f in some
    )
    assert len(reader.timestamps) == 40


def test_frames_not_wanted_are_not_converted(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    converted = []

    real = cv2.VideoCapture

    class Counting:
        """OpenCV's reader, which cannot be inherited from."""

        def __init__(self, *arguments: object) -> None:
            self._reader = real(*arguments)

        def __getattr__(self, name: str) -> object:
            converted.extend([name] * (name == "retrieve"))
            return getattr(self._reader, name)

    monkeypatch.setattr(cv2, "VideoCapture", Counting)
    for frame in VideoReader(shared_data / "videos" / "bedroom_848x364_58fps.mp4", range(199, 201)):
        if frame.source_index == 200:
            break
    assert len(converted) == 2


@pytest.mark.parametrize(
    ("name", "size", "decoded", "missing"),
    [
        ("d_odd_423x181_mjpeg.avi", (423, 181), 150, 30),
        ("d_one_frame.mp4", (848, 364), 1, 0),
        ("d_rotate90_metadata.mp4", (364, 848), 211, 0),
        ("d_truncated_60pct.mp4", (848, 364), 625, 466),
        ("d_vfr.mp4", (848, 364), 125, 0),
        ("tc_bt709_full_range.mp4", (1280, 720), 30, 0),
        ("tc_h264_10bits.mp4", (200, 200), 30, 0),
        ("tc_h265_10bits.mp4", (200, 200), 30, 0),
        ("tc_h265_video.mp4", (128, 128), 10, 0),
    ],
)
def test_odd_videos(shared_data: Path, name: str, size: tuple[int, int], decoded: int, missing: int) -> None:
    reader = VideoReader(shared_data / "odd_videos" / name, lambda i: i % 50 == 0)
    for frame in reader:
        assert frame.rgb.shape == (size[1], size[0], 3)
        assert frame.rgb.std() < 125
    assert (reader.info.width, reader.info.height) == size
    assert len(reader.timestamps) == decoded
    assert (np.diff(reader.timestamps) > 0).all()
    assert reader.missing_frames == missing


def test_rotation_turns_the_picture(shared_data: Path) -> None:
    turned = next(VideoReader(shared_data / "odd_videos" / "d_rotate90_metadata.mp4")).rgb.astype(float)
    upright = next(VideoReader(shared_data / "videos" / "bedroom_848x364_58fps.mp4")).rgb.astype(float)
    errors = [np.abs(turned - np.rot90(upright, k)).mean() for k in (1, 3)]
    assert min(errors) < 15 < max(errors)


def test_variable_rate_is_kept(shared_data: Path) -> None:
    steps = np.diff(iter_video_times(shared_data / "odd_videos" / "d_vfr.mp4"))
    assert steps.min() == pytest.approx(1 / 60, abs=1e-3)
    assert steps.max() > 3 / 60


def iter_video_times(path: Path) -> np.ndarray:
    """Decode without converting anything."""
    reader = VideoReader(path, ())
    assert list(reader) == []
    return reader.timestamps


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("d_empty.mp4", "is empty"),
        ("d_text.mp4", "is a text file"),
        ("tc_audio_only.mp3", "no video stream"),
        ("not_there.mp4", "no such file"),
        (".", "is a folder"),
    ],
)
def test_bad_files_are_explained(shared_data: Path, name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        probe_video(shared_data / "odd_videos" / name)


def test_playlists_pointers_and_long_texts_are_refused(tmp_path: Path) -> None:
    for name, text, message in [
        ("a.m3u8", "#EXTM3U\n#EXTINF:1,\nfile:///etc/hostname\n", "text file"),
        ("b.mp4", "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3\n", "git lfs pull"),
        ("c.mp4", "wörter über wörter " * 500, "text file"),
    ]:
        (tmp_path / name).write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=message):
            probe_video(tmp_path / name)


@pytest.mark.parametrize("name", ["x.m3u8", "x.mp4", "x.ffconcat", "x.avi"])
@pytest.mark.parametrize(
    "text",
    [
        b"#EXTM3U\n#\xff\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nsecret.mkv\n#EXT-X-ENDLIST\n",
        b"#EXTM3U\n#\0\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n%s\n#EXT-X-ENDLIST\n",
        b"ffconcat version 1.0\n#\xff\nfile secret.mkv\n",
    ],
)
def test_playlists_that_are_no_text_show_no_other_file(tmp_path: Path, name: str, text: bytes) -> None:
    write_video(tmp_path / "secret.mkv", list(textured(3, 32, 32)), 10)
    assert probe_video(tmp_path / "secret.mkv").width == 32
    (tmp_path / name).write_bytes(text.replace(b"%s", bytes(tmp_path / "secret.mkv")))
    with pytest.raises(InputError, match="no image can be decoded"):
        probe_video(tmp_path / name)


def test_one_image_is_no_video(tmp_path: Path) -> None:
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"img_{i:02d}.jpg"), np.full((32, 32, 3), 80 * i, np.uint8))
    (tmp_path / "img_%02d.mp4").write_bytes((tmp_path / "img_00.jpg").read_bytes())
    with pytest.raises(InputError, match="folder that contains the images"):
        probe_video(tmp_path / "img_00.jpg")
    with pytest.raises(InputError, match="no image can be decoded"):
        probe_video(tmp_path / "img_%02d.mp4")


def test_a_damaged_file_is_silent_on_stderr(tmp_path: Path) -> None:
    (tmp_path / "broken.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(range(256)) * 20)
    program = (
        "import sys; from msgs_slam.formats.video import probe_video; from msgs_slam.formats.errors import InputError\n"
        "try: probe_video(sys.argv[1])\n"
        "except InputError: print('refused')"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "broken.mp4")]
    done = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("refused\n", "")


def _run_clock(stored: list[float], fps: float = 10.0) -> Clock:
    clock = Clock(fps)
    for s in stored:
        clock.next(s)
    return clock


@pytest.mark.parametrize(
    ("stored", "times", "repairs"),
    [
        pytest.param([5.0, 5.1, 5.35, 5.4], [0, 0.1, 0.35, 0.4], 0, id="good times"),
        pytest.param([0.0, 0.1, 0.2, 0.05, 0.4, 0.5], [0, 0.1, 0.2, 0.3, 0.4, 0.5], 1, id="a wrong one"),
        pytest.param([0.0, 0.1, 0.2, 0.0, 0.1, 0.2], [0, 0.1, 0.2, 0.3, 0.4, 0.5], 3, id="anew"),
        pytest.param([0.0, 0.0, 0.0, 0.0], [0, 0.1, 0.2, 0.3], 3, id="none"),
        pytest.param([0.0, 0.1, 60.0, 60.1], [0, 0.1, 60.0, 60.1], 0, id="a pause"),
    ],
)
def test_times_are_kept_or_repaired(stored: list[float], times: list[float], repairs: int) -> None:
    clock = _run_clock(stored)
    assert (clock.times, clock.repairs) == (pytest.approx(times), repairs)


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True, min_value=None) | st.floats(0, 10), min_size=1))
def test_times_always_increase(stored: list[float]) -> None:
    times = _run_clock([s if abs(s) < 1e6 or s != s else float("inf") for s in stored]).times
    assert times[0] == 0
    assert all(b > a for a, b in itertools.pairwise(times))
    assert np.isfinite(times).all()


def hdr_signal(srgb: np.ndarray, transfer: str) -> np.ndarray:
    """(..., 3) uint16 BT.2020 signal of pictures (0..1), white is diffuse white; ITU-R BT.2100's forward curves."""
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    wide = linear @ np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]).T
    if transfer == "HLG":
        scene = wide * 0.26496
        signal = np.where(
            scene <= 1 / 12, np.sqrt(3 * scene), 0.17883277 * np.log(12 * scene.clip(0.03) - 0.28466892) + 0.55991073
        )
    else:
        power = (wide * 203 / 10000) ** 0.1593017578125
        signal = ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375
    return np.round(signal.clip(0, 1) * 65535).astype(np.uint16)


X265 = "log-level=none:pools=1:frame-threads=1:bframes=0:keyint=8:open-gop=0"


def write_hdr(path: Path, pictures: list[np.ndarray], transfer: str, aspect: Fraction | None = None) -> None:
    """10 bit HEVC that says its transfer function, pictures as uint16 RGB."""
    options = {"crf": "4", "preset": "ultrafast", "x265-params": X265}
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx265", rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = pictures[0].shape[1], pictures[0].shape[0], "yuv420p10le"
        context = stream.codec_context
        if aspect is not None:
            context.sample_aspect_ratio = aspect
        context.color_trc, context.color_primaries = {"PQ": 16, "HLG": 18}[transfer], 9
        context.colorspace, context.color_range = 9, 1
        for time, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb48le")
            frame = frame.reformat(format="yuv420p10le", dst_colorspace=9, dst_color_range=1)
            frame.pts, frame.time_base = time, Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.mark.parametrize("transfer", ["HLG", "PQ"])
def test_hdr_has_the_colours_of_the_scene(tmp_path: Path, transfer: str) -> None:
    patches = np.random.default_rng(0).uniform(0.05, 0.8, (4, 6, 3))
    picture = np.kron(patches, np.ones((16, 16, 1)))
    write_hdr(tmp_path / "a.mp4", [hdr_signal(picture, transfer)] * 3, transfer)
    reader = VideoReader(tmp_path / "a.mp4")
    frames = list(reader)
    assert (reader.hdr, reader.tone_mapped, reader.missing_frames) == (transfer, True, 0)
    assert [f.timestamp for f in frames] == pytest.approx([0, 0.1, 0.2])
    seen = frames[1].rgb[8::16, 8::16].astype(float)
    assert 0 < np.abs(seen - 255 * patches).mean() < 2.5


def test_hdr_has_no_bands_and_no_blown_whites(tmp_path: Path) -> None:
    ramp = np.repeat(np.linspace(0, 65535, 1024)[None, :, None], 32, axis=0).repeat(3, axis=2).astype(np.uint16)
    write_hdr(tmp_path / "a.mp4", [ramp], "HLG")
    (frame,) = VideoReader(tmp_path / "a.mp4")
    levels = frame.rgb[16, :, 1].astype(int)
    assert len(np.unique(levels)) > 240
    assert np.diff(levels).min() >= -1  # a codec
    assert np.diff(levels).max() <= 3
    assert 235 < levels[768] < 250  # diffuse white; what is brighter still rises
    assert levels[1000] > levels[768]


def test_hdr_upright(tmp_path: Path) -> None:
    """A phone held upright writes its turn into the track's matrix."""
    picture = np.zeros((64, 96, 3))
    picture[:32, :48] = 0.7, 0.2, 0.2
    write_hdr(tmp_path / "a.mp4", [hdr_signal(picture, "HLG")] * 2, "HLG")
    (tmp_path / "b.mp4").write_bytes((tmp_path / "a.mp4").read_bytes())
    with_matrix(tmp_path / "b.mp4", 0, 1, -1, 0)
    info = probe_video(tmp_path / "b.mp4")
    assert (info.width, info.height) == (64, 96)
    turned = next(VideoReader(tmp_path / "b.mp4")).rgb
    lying = next(VideoReader(tmp_path / "a.mp4")).rgb
    assert (turned == np.rot90(lying, -1)).all()  # as OpenCV turns such a file


def test_ordinary_videos_are_not_taken_for_hdr(counted_video: Path, tmp_path: Path) -> None:
    assert not VideoReader(counted_video).hdr
    write_hdr(tmp_path / "a.mp4", [np.zeros((64, 64, 3), np.uint16)] * 5, "PQ")
    data = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(InputError, match="no image can be decoded"):
        list(VideoReader(tmp_path / "cut.mp4"))


def test_names_that_are_no_utf_8_are_refused(tmp_path: Path) -> None:
    """OpenCV would end the process."""
    frames = [np.full((48, 64, 3), 9 * i, np.uint8) for i in range(5)]
    named = tmp_path / os.fsdecode(b"K\xfcche.avi")
    with pytest.raises(InputError, match="no valid UTF-8"):
        write_video(named, frames, 10.0)
    write_video(tmp_path / "good.avi", frames, 10.0).rename(named)
    with pytest.raises(InputError, match="no valid UTF-8"):
        probe_video(named)


def pictures() -> list[np.ndarray]:
    ramp = np.linspace(0, 200, 65 * 97, dtype=np.float32).reshape(65, 97)
    return [
        np.stack([ramp + 5 * i, ramp[::-1], np.full_like(ramp, 20.0 * i)], axis=2).astype(np.uint8) for i in range(7)
    ]


@pytest.mark.parametrize(("codec", "name"), [(H264, "h264"), (VP9, "vp9"), (MPEG4, "mpeg4")])
def test_each_codec_shows_the_pictures(codec: str, name: str, tmp_path: Path) -> None:
    given = pictures()
    assert write_browser_video(tmp_path / "out" / "v.mp4", given, 12.5, codec) == codec
    with av.open(str(tmp_path / "out" / "v.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name.removeprefix("lib").startswith(name)
        assert stream.average_rate == Fraction(25, 2)
        found = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(found) == len(given)
    assert found[0].shape == (64, 96, 3), "an odd row and column are left out"
    errors = [np.abs(a.astype(int) - b[:64, :96]).mean() for a, b in zip(found, given, strict=True)]
    assert 0 < max(errors) < 6


def test_the_best_codec_is_one_that_browsers_play(monkeypatch: pytest.MonkeyPatch) -> None:
    assert best_codec() == H264, "PyAV is there"
    monkeypatch.setattr("msgs_slam.formats.video_streams._has_x264", lambda: False)
    assert best_codec() in (VP9, MPEG4)


def test_no_picture_is_refused(tmp_path: Path) -> None:
    for codec in (H264, VP9):
        with pytest.raises(InputError, match="no frame"):
            write_browser_video(tmp_path / "v.mp4", [], 10.0, codec)
    assert list(tmp_path.iterdir()) == []
