"""Values as files: what comes back is what was saved, and nothing else is let in."""

import json
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
from msgs_slam.pipelines.system.values import load_value, save_value
from msgs_slam.pipelines.types import Intrinsics


def test_what_snapshots_are_made_of_comes_back(tmp_path: Path) -> None:
    sent = (
        RunFolder(tmp_path / "a.msgs"), Config(), None, True, 3, 0.1, "text", (1, 2), [Path("x"), ()],
        {4: np.arange(6.0).reshape(2, 3)}, Intrinsics(4, 3, 2.0, 2.0, 2.0, 1.5), ViewFigures(30.0, 0.9, 0.1, 1.0),
    )  # fmt: skip
    save_value(tmp_path / "sent.npz", sent)
    found = load_value(tmp_path / "sent.npz")
    assert [type(f) for f in found] == [type(s) for s in sent]
    np.testing.assert_array_equal(found[9][4], sent[9][4])  # type: ignore[index]
    assert (*found[:9], *found[10:]) == (*sent[:9], *sent[10:])


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


@pytest.mark.parametrize(
    "name", ["os:system", "engine:shutil", "system.values:save_value", "..:Config", "types:Nothing", "types:np"]
)
def test_what_is_not_of_this_program_is_refused(name: str, tmp_path: Path) -> None:
    for value in (object(), Foreign("x")):
        with pytest.raises(TypeError, match="is not kept in files"):
            save_value(tmp_path / "thing.npz", value)
    tree = np.frombuffer(json.dumps({name: {"path": "x", "value": 1}}).encode(), np.uint8)
    save_arrays(tmp_path / "call.npz", {"tree": tree})
    with pytest.raises(InputError, match=r"call\.npz is damaged or no value of this program .*: delete it"):
        load_value(tmp_path / "call.npz")
