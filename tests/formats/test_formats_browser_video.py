"""Videos for browsers, by each of the codecs."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.video_writer import H264, MPEG4, VP9, best_codec, write_browser_video


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


def test_the_best_codec_is_one_that_browsers_play(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert best_codec(tmp_path) == H264, "PyAV is there"
    monkeypatch.setattr("msgs_slam.formats.video_writer._has_x264", lambda: False)
    assert best_codec(tmp_path) in (VP9, MPEG4)
    assert list(tmp_path.iterdir()) == []


def test_no_picture_is_refused(tmp_path: Path) -> None:
    for codec in (H264, VP9):
        with pytest.raises(InputError, match="no frame"):
            write_browser_video(tmp_path / "v.mp4", [], 10.0, codec)
    assert list(tmp_path.iterdir()) == []
