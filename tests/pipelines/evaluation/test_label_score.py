"""Label scores against scikit-learn, and after a known share of flips."""

import numpy as np
import pytest

from msgs_slam.pipelines.evaluation.labels import (
    count_labels,
    indices_by_name,
    matched_by_majority,
    matched_one_to_one,
    renamed,
    score,
)
from msgs_slam.pipelines.types import VOID


def test_same_as_scikit_learn() -> None:
    metrics = pytest.importorskip("sklearn.metrics")
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 5, (40, 50)).astype(np.uint8)
    labels = np.where(rng.random(truth.shape) < 0.7, truth, rng.integers(0, 5, truth.shape)).astype(np.uint8)
    found = score(count_labels(labels, truth, 5, 5))
    assert found is not None
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
    assert found is not None
    assert found.pixel_accuracy == pytest.approx(0.5)
    assert found.unlabelled == pytest.approx(0.25)
    np.testing.assert_allclose(found.class_iou, [1 / 3, 1 / 2])
    absent = score(count_labels(labels, truth, 3, 3))
    assert absent is not None
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
    assert found is not None
    assert found.pixel_accuracy == pytest.approx(1 - share, abs=0.005)
    # As many pixels leave a class as come into it: union = 1 + share, intersection = 1 - share.
    assert found.mean_iou == pytest.approx((1 - share) / (1 + share), abs=0.01)


def test_renamed_classes_are_matched_back() -> None:
    rng = np.random.default_rng(2)
    truth = rng.integers(0, 4, (60, 60))
    clusters = np.array([2, 0, 3, 1])[truth]
    confusion = count_labels(clusters, truth, 6, 4)
    assert matched_one_to_one(confusion)[:4].tolist() == [1, 3, 0, 2]
    assert matched_one_to_one(confusion)[4:].tolist() == [-1, -1]
    found = score(renamed(confusion, matched_one_to_one(confusion)))
    assert found is not None
    assert found.mean_iou == 1
    split = np.where(rng.random(truth.shape) < 0.3, clusters + 4, clusters)
    by_majority = score(renamed(c := count_labels(split, truth, 8, 4), matched_by_majority(c)))
    one_to_one = score(renamed(c, matched_one_to_one(c)))
    assert by_majority is not None
    assert one_to_one is not None
    assert by_majority.mean_iou == 1
    assert one_to_one.mean_iou == pytest.approx(0.7, abs=0.03)


def test_names_find_each_other() -> None:
    found = indices_by_name(("Wall", "sofa ", "cat"), ("floor", "wall", "sofa"))
    assert found is not None
    assert found.tolist() == [1, 2, -1]
    assert indices_by_name(("segment 1",), ("wall",)) is None
    assert indices_by_name(("wall", "object1", "object2"), ("floor", "wall", "sofa")) is None
