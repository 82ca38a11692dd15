"""What pieces of evidence say together: exact for Gaussians, robust where one is wrong, and as sure as it should be."""

from pathlib import Path

import numpy as np
import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.msgs_cli.results import scale_lines
from msgs_slam.pipelines.run.files import METRES
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.scene.evidence import Evidence, Mode, combine, measured
from msgs_slam.pipelines.scene.metres import describe


def gaussian(kind: str, at: float, sd: float, wrong: float = 1e-9, is_guess: bool = False) -> Evidence:
    return Evidence(kind, kind, (Mode(at, sd),), wrong, is_guess)


def test_one_piece_is_what_it_says() -> None:
    found = combine([gaussian("a", np.log(0.83), 0.18)])
    assert found.factor == pytest.approx(0.83, rel=1e-4)
    assert found.sd == pytest.approx(0.18, rel=1e-3)


def test_two_pieces_average_by_their_variances_and_their_correlation_costs() -> None:
    found = combine([gaussian("a", 0.0, 0.1), gaussian("b", 0.1, 0.2)])
    assert found.log_scale == pytest.approx((0 / 0.01 + 0.1 / 0.04) / (1 / 0.01 + 1 / 0.04), abs=1e-4)
    independent = 1 / np.sqrt(1 / 0.01 + 1 / 0.04)
    assert independent < found.sd < 1.1 * independent


def test_many_of_a_kind_do_not_average_away_what_they_share() -> None:
    sds = [combine([gaussian("chair", 0.0, 0.1)] * n).sd for n in (1, 4, 100)]
    assert sds[0] > sds[1] > sds[2] > 0.1 * np.sqrt(0.5)


def test_a_guess_is_never_surer_than_what_all_its_sources_share() -> None:
    pieces = [gaussian(str(i), 0.0, 0.01, is_guess=True) for i in range(3)]
    assert combine(pieces).sd > 0.05 > combine([gaussian(str(i), 0.0, 0.01) for i in range(3)]).sd


def test_disagreement_widens_by_the_birge_ratio() -> None:
    agree, differ = ([gaussian("a", 0.0, 0.1), gaussian("b", at, 0.1)] for at in (0.02, 0.3))
    assert combine(agree).disagreement < 1
    assert combine(differ).disagreement > 1.5
    assert combine(differ).sd == pytest.approx(combine(agree).sd * combine(differ).disagreement, rel=0.02)


def test_an_outlier_is_left_out_and_makes_less_sure() -> None:
    good = [gaussian("a", 0.0, 0.1, 0.05), gaussian("b", 0.05, 0.1, 0.05), gaussian("c", -0.05, 0.1, 0.05)]
    wrong = gaussian("d", 1.5, 0.1, 0.05)
    assert abs(combine([*good, wrong]).log_scale) < 0.05
    assert combine([*good, wrong]).sd > 1.3 * combine(good).sd


def test_the_right_reading_of_a_length_is_picked_by_the_others() -> None:
    top = measured("table", "table", 0.74, ((0.74, 0.05, 0.5), (0.43, 0.1, 0.5)))
    assert top.sd > 0.25  # it could be either
    found = combine([top, gaussian("camera", 0.1, 0.2)])
    assert abs(found.log_scale) < 0.05
    assert found.sd < 0.15


def test_stated_sigmas_hold_for_worlds_drawn_from_the_priors() -> None:
    """Sources that err as they say, one in twenty of them not at all: within two sigmas in nine of ten worlds."""
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(200):
        pieces = []
        for k, sd in enumerate((0.15, 0.25, 0.3, 0.5)):
            is_wrong = rng.random() < 0.05
            pieces.append(gaussian(str(k), rng.normal(0, 1.0 if is_wrong else sd), sd, 0.05, True))
        found = combine(pieces)
        inside.append(abs(found.log_scale) < 2 * found.sd)
    assert 0.9 < np.mean(inside) < 1.0


def test_what_is_stated_survives_the_disk_and_stands_in_status(tmp_path: Path) -> None:
    """A guess says that it is one; a run whose export is not done says nothing."""
    metres = describe([
        measured("door", "door", 2.4, ((2.02, 0.05, 1.0),)),
        measured("door", "door", 2.5, ((2.02, 0.05, 1.0),)),
        measured("floor height", "camera height", 1.8, ((1.45, 0.2, 1.0),)),
    ])  # fmt: skip
    run = RunFolder(tmp_path)
    METRES.save(run.stage("export"), metres)
    assert run.find(METRES) == metres
    (line,) = scale_lines(tmp_path, {"export": None})  # type: ignore[dict-item]
    assert "1 unit = about 0.8" in line
    assert line.endswith("(estimated from 2 doors and floor height)")
    assert scale_lines(tmp_path, {}) == []
    METRES.save(run.stage("export"), None)
    assert run.find(METRES) is None
    (run.stage("export") / "scale.json").write_text('{"per_unit": "long"}')
    with pytest.raises(InputError, match=r"scale.json"):
        run.find(METRES)
