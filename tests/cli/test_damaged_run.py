"""Damage to a finished run: found, named, and never used. `tests/benchmarks/damage.py` tries all of it."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from cli_runs import invoke

from msgs_slam.formats.errors import InputError
from msgs_slam.msgs_cli.output import format_table
from msgs_slam.pipelines.evaluation.serve import page_of_run
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.system.wording import figure_text, lost_text, stretches

USED_BY = {
    "frames/frames.json": "ply",
    "frames/000003.jpg": "colmap",
    "frames/calibration.json": "tum",
    "proxy/classes.json": "tum",
    "global_ba/map.safetensors": "ply",
    "global_ba/trajectory.npz": "tum",
    "global_ba/sparse.npz": "colmap",
    "export/scale.json": "tum",
}


def spoil(path: Path, how: str) -> None:
    if how == "deleted":
        path.unlink()
    elif how == "cut":
        path.write_bytes(path.read_bytes()[:-7])
    else:
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)


@pytest.mark.parametrize("how", ["deleted", "cut", "flipped"])
def test_damage_is_named_and_never_used(how: str, copied_run: Callable[[str], Path], tmp_path: Path) -> None:
    run = copied_run("run.msgs")
    for file, kind in USED_BY.items():
        whole = (run / file).read_bytes()
        spoil(run / file, how)
        refused = invoke("export", run, "--only", kind, "--to", tmp_path / "out", "-q")
        assert refused.exit_code == 1, file
        assert str(run / file) in refused.stderr
        assert f"msgs-slam resume {run}" in refused.stderr
        stage, _, name = file.partition("/")
        status = invoke("status", run).stdout
        assert f"{stage}: 1 of its " in status
        assert name in status
        (run / file).write_bytes(whole)
    assert invoke("export", run, "--only", "tum", "--to", tmp_path / "out", "-q").exit_code == 0


def test_a_damaged_page_is_not_shown(copied_run: Callable[[str], Path]) -> None:
    run = copied_run("run.msgs")
    assert page_of_run(RunFolder(run)) == (run / "export" / "map.html").read_text()
    for how in ("flipped", "cut", "deleted"):
        spoil(run / "export" / "map.html", how)
        with pytest.raises(InputError, match=r"map\.html is .*msgs-slam resume"):
            page_of_run(RunFolder(run))


def test_damaged_export_is_made_again(copied_run: Callable[[str], Path]) -> None:
    run = copied_run("run.msgs")
    before = RunFolder(run).records["export"].content
    spoil(run / "export" / "mesh.ply", "flipped")
    spoil(run / "export" / "point_cloud.ply", "cut")
    assert json.loads(invoke("status", run, "--json").stdout)["stages"][-1]["state"] == "damaged"
    assert invoke("resume", run, "-q").exit_code == 0
    assert RunFolder(run).records["export"].content == before
    found = json.loads(invoke("status", run, "--json").stdout)
    assert [s["state"] for s in found["stages"]] == ["done"] * 6
    assert found["warnings"] == []
    assert found["stages"][0]["record"]["figures"]["frames"] == 14


def test_settings_that_are_gone_are_made_again_from_the_records(copied_run: Callable[[str], Path]) -> None:
    run = copied_run("run.msgs")
    before = (run / "run.toml").read_bytes()
    (run / "run.toml").unlink()
    assert invoke("resume", run, "-q").exit_code == 0
    assert (run / "run.toml").read_bytes() == before


def test_lost_frames_of_one_cause_are_told_together() -> None:
    assert stretches([7, 1, 2, 3]) == "1-3, 7"
    assert stretches(range(0, 100, 2), limit=3) == "0, 2, 4 and 47 more stretches"
    lost = {str(i): "blurred" if i == 8 else "too few matches" for i in range(5, 12)}
    assert lost_text(lost) == "7 (too few matches 5-7, 9-11; blurred 8)"
    assert figure_text({}, "lost") == "none"
    assert len(figure_text({str(2 * i): "too few matches" for i in range(5000)}, "lost")) < 200
    table = format_table(["stage", "figures"], [["tracking", "posed 3, lost none, " * 20]], width=60)
    assert max(map(len, table.splitlines())) <= 60
