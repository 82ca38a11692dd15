"""A camera that a data set states is held, whatever its lens, unless the pictures refute it."""

from pathlib import Path

import numpy as np
import pytest

from msgs_slam.formats.datasets.sequence import Camera
from msgs_slam.pipelines.sfm.lens import to_pycolmap
from tests.pipelines.frames.made_views import structure_of, walk_round

KINECT = Camera(640, 480, 517.3, 516.5, 319.1, 255.8, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
PLAIN = Camera(640, 480, 520.0, 520.0, 320.0, 240.0)


@pytest.mark.parametrize("mapper", ["global", "incremental"])
@pytest.mark.parametrize("camera", [KINECT, PLAIN], ids=["strong_distortion", "plain"])
def test_a_true_camera_is_held(camera: Camera, mapper: str, tmp_path: Path) -> None:
    """COLMAP's mappers take a camera with a coefficient above 1 for bogus unless told otherwise."""
    true = to_pycolmap(camera)
    made = walk_round(true)
    structure = structure_of(made, true, tmp_path, is_stated=True)
    found = structure._map(made.views(), made.pairs(true), (mapper,))
    assert found is not None
    assert found[0].num_reg_images() == 20
    found = structure._calibrated(made.views(), made.pairs(true))
    assert found is not None
    assert found.model.cameras[1].params.tolist() == true.params.tolist()
    assert made.off(found.model) < 0.01


def test_a_camera_that_the_pictures_refute_is_found_anew(tmp_path: Path) -> None:
    made = walk_round(to_pycolmap(PLAIN))
    stated = to_pycolmap(Camera(640, 480, 620.0, 620.0, 320.0, 240.0))
    pairs = made.pairs(stated)
    held = structure_of(made, stated, tmp_path)._calibrated(made.views(), pairs)
    found = structure_of(made, stated, tmp_path, is_stated=True)._calibrated(made.views(), pairs)
    assert held is not None
    assert found is not None
    assert held.model.cameras[1].mean_focal_length() == 620
    assert found.model.cameras[1].mean_focal_length() == pytest.approx(520, rel=0.01)
    assert made.off(found.model) < 0.01
    assert made.off(found.model) < made.off(held.model) / 3
    assert np.isfinite(found.focal_sd)
    assert found.focal_sd > 0
