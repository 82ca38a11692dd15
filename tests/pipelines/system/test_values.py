"""Tasks and results as files: what comes back is what was sent, and nothing else is let in."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.tensors import save_arrays
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.depth.fields import DepthFields
from msgs_slam.pipelines.mapping.measure import ViewFigures
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.system.values import load_value, name_of, of_name, save_value
from msgs_slam.pipelines.types import Intrinsics


def test_what_tasks_are_made_of_comes_back(tmp_path: Path) -> None:
    sent = (
        RunFolder(tmp_path / "a.msgs"), Config(), None, True, 3, 0.1, "text", (1, 2), [Path("x"), ()],
        {4: np.arange(6.0).reshape(2, 3)}, Intrinsics(4, 3, 2.0, 2.0, 2.0, 1.5), ViewFigures(30.0, 0.9, 0.1, 1.0),
    )  # fmt: skip
    save_value(tmp_path / "sent.npz", sent)
    found = load_value(tmp_path / "sent.npz")
    assert [type(f) for f in found] == [type(s) for s in sent]
    np.testing.assert_array_equal(found[9][4], sent[9][4])  # type: ignore[index]
    assert (*found[:9], *found[10:]) == (*sent[:9], *sent[10:])


def test_names_on_disk_are_short_and_of_no_file() -> None:
    assert [name_of(c) for c in (Intrinsics, Config, RunFolder, DepthFields)] == [
        "types:Intrinsics", "config:Config", "run:RunFolder", "depth:DepthFields",
    ]  # fmt: skip
    assert all(of_name(name_of(c)) is c for c in (Intrinsics, Config, RunFolder, DepthFields))


def test_scale_fields_come_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    fields = DepthFields({7: rng.random((2, 3))})
    save_value(tmp_path / "fields.npz", fields)
    found = load_value(tmp_path / "fields.npz")
    assert str(asdict(found)) == str(asdict(fields))


@dataclass(frozen=True)
class Foreign:
    """Not of this program's pipelines."""

    text: str


def test_what_is_not_of_this_program_is_refused(tmp_path: Path) -> None:
    for name in ("os:system", "engine:shutil", "system:save_arrays", "system:of_name.cache_clear", "..:Config",
                 "msgs_slam.pipelines.types:Frame"):  # fmt: skip
        with pytest.raises(InputError, match="install the same one everywhere"):
            of_name(name)
    for value in (object(), Foreign("x"), dataclass(type("Frame", (), {"__module__": Intrinsics.__module__}))()):
        with pytest.raises(TypeError, match="does not travel"):
            save_value(tmp_path / "thing.npz", value)
    tree = np.frombuffer(b'{"system:save_value": {"path": "x", "value": 1}}', np.uint8)
    save_arrays(tmp_path / "call.npz", {"tree": tree})
    with pytest.raises(
        InputError, match=r"call\.npz is damaged or no value of this program .*no dataclass.*: delete it"
    ):
        load_value(tmp_path / "call.npz")
