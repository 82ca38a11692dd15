"""Label scores against scikit-learn and known flips; class maps join names that differ, and nonsense is refused."""

from pathlib import Path

import numpy as np
import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.evaluation.labels import (
    Matching,
    count_labels,
    indices_by_name,
    label_cells,
    match_classes,
    matched_by_majority,
    matched_one_to_one,
    open_class_map,
    read_class_map,
    score,
    shipped_maps,
)
from msgs_slam.pipelines.types import VOID


def test_same_as_scikit_learn() -> None:
    metrics = pytest.importorskip("sklearn.metrics")
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 5, (40, 50)).astype(np.uint8)
    labels = np.where(rng.random(truth.shape) < 0.7, truth, rng.integers(0, 5, truth.shape)).astype(np.uint8)
    found = score(count_labels(labels, truth, 5, 5))
    theirs = metrics.jaccard_score(truth.ravel(), labels.ravel(), average=None)
    np.testing.assert_allclose(found.class_iou, theirs, atol=1e-12)
    assert found.mean_iou == pytest.approx(theirs.mean())
    assert found.pixel_accuracy == pytest.approx(metrics.accuracy_score(truth.ravel(), labels.ravel()))
    np.testing.assert_array_equal(
        count_labels(labels, truth, 5, 5)[:, :5], metrics.confusion_matrix(truth.ravel(), labels.ravel())
    )


def test_void_truth_is_left_out_and_void_answers_count_against() -> None:
    truth = np.array([[0, 0, 1, 1, VOID, VOID]], np.uint8)
    labels = np.array([[0, VOID, 1, 0, 0, 1]], np.uint8)
    found = score(count_labels(labels, truth, 2, 2))
    assert found.pixel_accuracy == pytest.approx(0.5)
    assert found.unlabelled == pytest.approx(0.25)
    np.testing.assert_allclose(found.class_iou, [1 / 3, 1 / 2])
    absent = score(count_labels(labels, truth, 3, 3))
    assert np.isnan(absent.class_iou[2])
    assert absent.mean_iou == pytest.approx(found.mean_iou)
    assert score(count_labels(labels, np.full_like(truth, VOID), 2, 2)) is None


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3])
def test_flipped_pixels_cost_what_theory_says(share: float) -> None:
    rng = np.random.default_rng(1)
    classes = 4
    truth = rng.integers(0, classes, (300, 300))
    flip = rng.random(truth.shape) < share
    labels = np.where(flip, (truth + rng.integers(1, classes, truth.shape)) % classes, truth)
    found = score(count_labels(labels, truth, classes, classes))
    assert found.pixel_accuracy == pytest.approx(1 - share, abs=0.005)
    # As many pixels leave a class as come into it: union = 1 + share, intersection = 1 - share.
    assert found.mean_iou == pytest.approx((1 - share) / (1 + share), abs=0.01)


def clustered(confusion: np.ndarray, match: np.ndarray) -> float:
    found = score(Matching(("a", "b", "c", "d"), match, np.arange(4), "").joined(confusion))
    return found.mean_iou


def test_renamed_classes_are_matched_back() -> None:
    rng = np.random.default_rng(2)
    truth = rng.integers(0, 4, (60, 60))
    clusters = np.array([2, 0, 3, 1])[truth]
    confusion = count_labels(clusters, truth, 6, 4)
    assert matched_one_to_one(confusion).tolist() == [1, 3, 0, 2, -1, -1]
    assert clustered(confusion, matched_one_to_one(confusion)) == 1
    split = count_labels(np.where(rng.random(truth.shape) < 0.3, clusters + 4, clusters), truth, 8, 4)
    assert clustered(split, matched_by_majority(split)) == 1
    assert clustered(split, matched_one_to_one(split)) == pytest.approx(0.7, abs=0.03)


def test_names_find_each_other() -> None:
    found = indices_by_name(("Wall", "sofa ", "cat"), ("floor", "wall", "sofa"))
    assert found.tolist() == [1, 2, -1]
    assert indices_by_name(("segment 1",), ("wall",)) is None
    assert indices_by_name(("wall", "object1", "object2"), ("floor", "wall", "sofa")) is None


THEIRS = ("couch", "stool", "wall", "shoe")
ADE20K = ("wall", "floor", "ceiling", "sofa", "armchair", "table", "cabinet", "painting", "windowpane", "rug", "tree")
WHITEROOM = ("wall", "floor", "woodwork", "sofa", "picture", "carpet", "tableware", "window")


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text)
    return path


def test_joined_names_are_one_class_and_the_others_are_left_out(tmp_path: Path) -> None:
    given = read_class_map(write(tmp_path, '[classes]\nSofa = "couch"\nchair = ["couch", "Stool"]\nwall = "wall"\n'))
    found = given.match(("wall", "sofa", "lamp"), ("wall", "sofa", "chair", "lamp"), THEIRS)
    assert found.names == ("couch / stool", "wall")
    assert found.of_ours.tolist() == [1, 0, -1]
    assert found.of_truth.tolist() == [0, 0, 1, -1]
    # Rows: couch, stool, wall, shoe; columns: wall, sofa, lamp, none.
    confusion = np.array([[1, 5, 2, 0], [0, 3, 0, 4], [7, 1, 1, 1], [9, 9, 9, 9]])
    assert found.joined(confusion).tolist() == [[8, 1, 6], [1, 7, 2]]
    cells = label_cells(confusion, found, "onnx:net", THEIRS)
    assert cells["matching"] == "by mine"
    assert cells["class_recall"] == {"couch / stool": 8 / 15, "wall": 0.7}
    assert cells["class_iou"] == {"couch / stool": 8 / 16, "wall": 7 / 11}


def test_a_class_that_the_run_knows_and_did_not_find_counts(tmp_path: Path) -> None:
    given = read_class_map(write(tmp_path, '[classes]\nwall = "wall"\nsofa = "couch"\nchair = "stool"\n'))
    knows = given.match(("wall",), ("wall", "sofa"), THEIRS)
    assert knows.names == ("couch", "wall")
    cells = label_cells(np.array([[6, 0], [9, 9], [10, 0], [5, 5]]), knows, "onnx:net", THEIRS)
    assert cells["class_iou"] == {"couch": 0.0, "wall": 10 / 16}
    assert cells["mean_iou"] == pytest.approx(5 / 16)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('sofa = "couch"\n', r"\[classes\]"),
        ("[classes]\nsofa = 3\n", "a name or a list of names"),
        ("[classes]\nsofa = []\n", "a name or a list of names"),
        ("[classes]\n[others]\n", "is not a class map"),
        ("[classes\n", "mine.toml"),
    ],
)
def test_what_is_no_class_map_is_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_class_map(write(tmp_path, text))


def test_unknown_classes_are_named_with_the_nearest(tmp_path: Path) -> None:
    lines = '[classes]\nsofaa = ["coach", "wall"]\nwall = "wall"\nxyzzy = "coach"\nbed = "wall"\n'
    given = read_class_map(write(tmp_path, lines))
    assert given.unknown(("Sofa", "wall"), THEIRS) == [
        "'sofaa' (did you mean 'sofa'?) of the run",
        "'xyzzy' of the run",
        "'coach' (did you mean 'couch'?) of the truth",
    ]
    assert given.match(("sofa", "wall"), (), THEIRS).names == ("wall",)
    with pytest.raises(InputError, match="joins none"):
        given.match(("sofa",), ("sofa",), THEIRS)
    with pytest.raises(InputError, match="known: ade20k-replica"):
        open_class_map("ade20k-mars")


def test_the_map_that_fits_is_found_and_none_where_it_is_not_sure(caplog: pytest.LogCaptureFixture) -> None:
    found = match_classes(("wall", "sofa", "object 1"), ADE20K, WHITEROOM, None)
    assert found.how == "by ade20k-whiteroom"
    assert found.names == ("wall", "floor", "sofa", "picture", "carpet", "window")
    assert found.of_ours.tolist() == [0, 2, -1]
    # Regions without names have no vocabulary; names that are all the truth's need no map.
    assert match_classes(("wall", "object 1", "object 2"), (), WHITEROOM, None) is None
    same = match_classes(("wall", "sofa"), ADE20K, WHITEROOM, None)
    assert same.how == "by name"
    # Replica's and ScanNet's names both hold these.
    assert match_classes(("rug", "armchair", "wall"), ADE20K, ("wall", "table", "picture"), None) is None
    assert "choose one with --class-map ade20k-replica or ade20k-scannet" in caplog.text


def test_the_maps_that_come_with_the_program_are_sound() -> None:
    maps = shipped_maps()
    assert [m.name for m in maps] == ["ade20k-replica", "ade20k-scannet", "ade20k-whiteroom"]
    for found in maps:
        assert found.unknown((), found.truth) == []
        assert {t for _, others in found.pairs for t in others} <= set(found.truth)
