"""Names that two programs spell differently."""

import unicodedata
from pathlib import Path

import pytest

from msgs_slam.formats.image_folder import match_names, named_file


@pytest.mark.parametrize(
    ("wanted", "having", "expected"),
    [
        (["/a/images/0.jpg"], ["0.jpg"], [0]),
        (["/a/images/0.heic"], ["sub\\0.JPG"], [0]),
        (["/a/cam_a/0.jpg", "/a/cam_b/0.jpg"], ["cam_b/0.jpg", "cam_a/0.jpg"], [1, 0]),
        (["/a/cam_a/0.jpg"], ["cam_b/0.jpg", "cam_a/0.jpg"], [1]),
        (["/a/photos/0.jpg"], ["cam_b/0.jpg", "cam_a/0.jpg"], [None]),
        (["/a/x/0.jpg", "/a/y/0.jpg"], ["0.jpg"], [None, None]),
        (["/a/x/0.jpg", "/a/y/0.jpg"], ["y/0.jpg"], [None, 0]),
        (["A.jpg"], ["a.jpg"], [0]),
        (["A.jpg"], ["a.jpg", "A.jpg"], [1]),
        (["aA.jpg"], ["aa.jpg", "AA.jpg"], [None]),
        (["a.jpg"], ["a.png", "a.jpg"], [1]),
        (["12.5.jpg"], ["12.5", "12.75"], [0]),
        ([unicodedata.normalize("NFD", "Küche.jpg")], ["Küche.jpg"], [0]),
        (["b.jpg"], ["a.jpg"], [None]),
    ],
)
def test_the_longest_common_end_and_the_nearest_spelling_win(
    wanted: list[str], having: list[str], expected: list[int | None]
) -> None:
    assert match_names(wanted, having) == expected


def test_a_file_is_found_in_another_case_or_form_where_one_fits(tmp_path: Path) -> None:
    file = tmp_path / "Images" / unicodedata.normalize("NFD", "Küche 1.JPG")
    file.parent.mkdir()
    file.touch()
    name = unicodedata.normalize("NFC", "images/küche 1.jpg")
    assert named_file([tmp_path], name, tmp_path / "x") == file
    (file.parent / unicodedata.normalize("NFD", "küche 1.JPG")).touch()
    if len(list(file.parent.iterdir())) == 2:  # a disk that tells cases apart
        assert named_file([tmp_path], name, tmp_path / "x") is None
