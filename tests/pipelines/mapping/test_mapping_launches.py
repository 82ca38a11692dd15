"""What a card is asked to do, counted on one that is only pretended; with a card the kernels are not interpreted."""

import os

import pytest
import torch

if torch.cuda.is_available():
    pytest.skip("the count needs kernels that are interpreted", allow_module_level=True)
os.environ["TRITON_INTERPRET"] = "1"  # read when triton is imported and again when the kernels are
pytest.importorskip("triton", minversion="3.3", reason="needs triton >= 3.3: pip install '.[cuda-check]'")

from tests.benchmarks.launches import VIEWS, measure


def test_a_card_is_asked_for_little_and_seldom_waited_for() -> None:
    """The limits are a little above what is done: an operation that slips in by the view or by the Gaussian is seen."""
    rows = {name: found.counts for name, found in measure().items()}
    colors, poses, noting, votes, stereo = rows.values()
    assert 30 < colors["launches"] <= 50
    assert (colors["reads"], colors["bytes from it"]) == (1, 0)
    assert (poses["reads"], poses["bytes from it"]) == (1, 2 * 16 * 4)
    assert noting["launches"] <= 72
    assert (noting["reads"], noting["bytes from it"]) == (1, 0)
    assert votes["launches"] <= 60 * VIEWS  # one pass by class, one for the whole
    assert stereo["launches"] <= 36  # matched at two sizes
    assert stereo["reads"] == 5
