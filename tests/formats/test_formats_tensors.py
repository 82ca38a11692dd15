"""Array files: nothing lost, nothing executed, the same bytes every time."""

import os
import pickle
import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import torch

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.tensors import (
    HEADERS,
    load_arrays,
    load_tensors,
    save_arrays,
    save_tensors,
)

REPO = Path(__file__).resolve().parents[2]
ARRAYS = {
    "b": np.arange(12, dtype=np.float32).reshape(3, 4),
    "a": np.array([1, 2, 255], np.uint8),
    "empty": np.zeros((0, 3), np.float64),
    "strided": np.arange(20, dtype=np.int64).reshape(4, 5)[::2, ::-2],
    "flag": np.array([True, False]),
    "half": np.array([0.5, -2], np.float16),
}


def test_safetensors_round_trip(tmp_path: Path) -> None:
    save_tensors(tmp_path / "t.safetensors", ARRAYS)
    foreign = safetensors.numpy.load_file(str(tmp_path / "t.safetensors"))
    for name, array in ARRAYS.items():
        assert foreign[name].dtype == array.dtype
        np.testing.assert_array_equal(foreign[name], array)


def test_tensors_round_trip_with_their_layout_undone(tmp_path: Path) -> None:
    tensors = {"t": torch.arange(12.0).reshape(3, 4).T, "i": torch.tensor(7), "g": torch.ones(2, requires_grad=True)}
    save_tensors(tmp_path / "t.safetensors", tensors)
    back = load_tensors(tmp_path / "t.safetensors")
    assert all(torch.equal(back[name], tensor) for name, tensor in tensors.items())
    (tmp_path / "t.safetensors").write_bytes(b"no")
    with pytest.raises(InputError, match="damaged"):
        load_tensors(tmp_path / "t.safetensors")


def test_npz_round_trip(tmp_path: Path) -> None:
    for compress in (True, False):
        save_arrays(tmp_path / "t.npz", ARRAYS, compress=compress)
        back = load_arrays(tmp_path / "t.npz")
        assert set(back) == set(ARRAYS)
        for name, array in ARRAYS.items():
            assert back[name].dtype == array.dtype
            np.testing.assert_array_equal(back[name], array)


def test_bytes_do_not_depend_on_process_or_order(tmp_path: Path) -> None:
    program = (
        "import sys; import numpy as np; from pathlib import Path; from msgs_slam.formats.tensors import *\n"
        "names = sys.argv[2].split(',')\n"
        "arrays = {n: np.arange(ord(n)) for n in names}\n"
        "save_tensors(Path(sys.argv[1] + '.safetensors'), arrays)\n"
        "save_arrays(Path(sys.argv[1] + '.npz'), arrays)"
    )
    for name, order, seed in (("one", "a,b,c,d,e,f", "1"), ("two", "f,c,e,a,d,b", "2")):
        command = [sys.executable, "-c", program, str(tmp_path / name), order]
        subprocess.run(command, cwd=REPO, check=True, env={**os.environ, "PYTHONHASHSEED": seed})
    for suffix in (".safetensors", ".npz"):
        assert (tmp_path / f"one{suffix}").read_bytes() == (tmp_path / f"two{suffix}").read_bytes()


def test_nothing_in_a_file_is_executed(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple:
            return (Path.touch, (tmp_path / "sprung",))

    np.savez(tmp_path / "trap.npz", a=np.array([Trap()], dtype=object))
    (tmp_path / "trap.safetensors").write_bytes(pickle.dumps(Trap()))
    with pytest.raises(InputError, match=r"no \.npz file of plain arrays"):
        load_arrays(tmp_path / "trap.npz")
    with pytest.raises(InputError, match="damaged"):
        load_tensors(tmp_path / "trap.safetensors")
    assert not (tmp_path / "sprung").exists()
    with pytest.raises(ValueError, match=r"[Oo]bject"):
        save_arrays(tmp_path / "o.npz", {"a": np.array([Trap()], dtype=object)})
    assert not (tmp_path / "o.npz").exists()


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_damaged_files_are_explained(tmp_path: Path, suffix: str) -> None:
    path, load = tmp_path / f"t{suffix}", load_arrays if suffix == ".npz" else load_tensors
    with pytest.raises(InputError, match="no such file"):
        load(path)
    (save_arrays if suffix == ".npz" else save_tensors)(path, ARRAYS)
    data = path.read_bytes()
    for keep in (0, 5, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:keep])
        with pytest.raises(InputError, match="damaged"):
            load(path)


def test_arrays_larger_than_the_limit_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("msgs_slam.formats.tensors.MAX_UNPACKED_BYTES", 100_000)
    np.savez_compressed(tmp_path / "bomb.npz", a=np.zeros(1_000_000, np.uint8))
    assert (tmp_path / "bomb.npz").stat().st_size < 10_000
    with pytest.raises(InputError, match="unpack"):
        load_arrays(tmp_path / "bomb.npz")


def test_a_header_that_claims_more_than_the_entry(tmp_path: Path) -> None:
    header = b"\x93NUMPY\x01\x00" + (118).to_bytes(2, "little")
    header += b"{'descr': '|u1', 'fortran_order': False, 'shape': (99999999999999,), }".ljust(117) + b"\n"
    with zipfile.ZipFile(tmp_path / "liar.npz", "w") as archive:
        archive.writestr("a.npy", header + b"few")
    with pytest.raises(InputError, match="damaged"):
        load_arrays(tmp_path / "liar.npz")


def test_headers_of_arrays_are_read_one_at_a_time(tmp_path: Path) -> None:
    """Two threads that parse at once end CPython 3.11's parser with a SystemError."""
    save_arrays(tmp_path / "a.npz", {"a": np.arange(6).reshape(2, 3).T, "b": np.array(2.5)})
    with ThreadPoolExecutor(1) as pool:
        with HEADERS:
            loading = pool.submit(load_arrays, tmp_path / "a.npz")
            with pytest.raises(TimeoutError):
                loading.result(0.3)
        found = loading.result()
    np.testing.assert_array_equal(found["a"], [[0, 3], [1, 4], [2, 5]])
    assert found["b"] == 2.5
