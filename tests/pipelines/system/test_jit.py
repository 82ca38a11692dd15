"""Where compiled kernels are kept: a writable place of our own, or nowhere, and the user is told."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from msgs_slam.pipelines.system import jit

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(autouse=True)
def _fresh(monkeypatch, tmp_path):
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    jit.cache_root.cache_clear()
    yield
    jit.cache_root.cache_clear()


def unwritable(monkeypatch, tmp_path, name: str) -> None:
    """A folder cannot be made inside a file, not even by root."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(name, str(tmp_path / "file" / "home"))


def test_the_place_the_user_names_comes_first(monkeypatch, tmp_path, recwarn):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "mine"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert jit.cache_root().parent == tmp_path / "mine"
    assert not recwarn.list


def test_else_the_users_cache_folder(monkeypatch, tmp_path, recwarn):
    monkeypatch.setenv("HOME", str(tmp_path))
    directory = jit.cache_root()
    assert directory.parent == tmp_path / ".cache" / "msgs-slam"
    assert directory.stat().st_mode & 0o777 == 0o700
    assert not recwarn.list


def test_a_home_that_cannot_be_written_is_said_once(monkeypatch, tmp_path):
    unwritable(monkeypatch, tmp_path, "HOME")
    with pytest.warns(UserWarning, match="compiled kernels are kept in") as warned:
        found = [jit.cache_root() for _ in range(3)]
    assert len(warned) == 1
    assert found[0] == found[1] == found[2]
    assert found[0].parent == tmp_path / "tmp"
    assert found[0].stat().st_mode & 0o777 == 0o700


def test_a_user_without_a_home_is_told_where_kernels_are(monkeypatch, tmp_path):
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as for an unknown user without HOME
    monkeypatch.chdir(tmp_path)
    with pytest.warns(UserWarning, match="a home folder, which this user lacks: compiled kernels are kept in"):
        assert jit.cache_root().parent == tmp_path / "tmp"
    assert [p.name for p in tmp_path.iterdir()] == ["tmp"]


def test_no_place_at_all_is_said(monkeypatch, tmp_path):
    unwritable(monkeypatch, tmp_path, "HOME")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "file" / "tmp"))
    with pytest.warns(UserWarning, match="compiled at every start"):
        assert jit.cache_root() is None


def test_a_folder_others_may_write_to_is_not_trusted(monkeypatch, tmp_path):
    """The cache is machine code: who can write it can run anything as us."""
    unwritable(monkeypatch, tmp_path, "HOME")
    planted = tmp_path / "tmp" / f"msgs-slam-{os.getuid()}-kernels"
    planted.mkdir()
    planted.chmod(0o777)
    with pytest.warns(UserWarning, match="compiled at every start"):
        assert jit.cache_root() is None


def test_a_kernel_follows_what_other_files_put_into_it(tmp_path):
    """numba itself would go on using the machine code into which the older function is inlined."""
    room = tmp_path / "msgs_slam" / "pipelines"
    (room / "system").mkdir(parents=True)
    for name in ("__init__", "jit", "identity"):
        shutil.copyfile(ROOT / "pipelines" / "system" / f"{name}.py", room / "system" / f"{name}.py")
    for name in ("__init__", "errors", "reading"):
        (room.parent / "formats").mkdir(exist_ok=True)
        shutil.copyfile(ROOT / "formats" / f"{name}.py", room.parent / "formats" / f"{name}.py")
    (room.parent / "__init__.py").write_text("")
    (room / "__init__.py").write_text("")
    (room / "kernel.py").write_text(
        "from .inlined import value\nfrom .system.jit import kernel\n\n"
        "@kernel\ndef twice(x):\n    return 2 * value(x)\n\n"
        "print(twice(1.0), sum(twice.stats.cache_hits.values()))\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    said = []
    for factor in (3, 3, 5):
        (room / "inlined.py").write_text(
            f"from .system.jit import kernel\n\n@kernel\ndef value(x):\n    return {factor} * x\n"
        )
        command = [sys.executable, "-m", "msgs_slam.pipelines.kernel"]
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        said.append(done.stdout.strip())
    assert said == ["6.0 0", "6.0 1", "10.0 0"]


def test_no_other_way_to_numba_and_no_fastmath():
    """Equal bytes over thread counts need floats that are taken literally; the renderer says what it allows."""
    for path in (ROOT / "pipelines").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if path.name != "jit.py":
            assert "njit" not in text, path
            assert "fastmath=" not in text, path


def test_kernels_run_and_are_cached_without_a_home(tmp_path):
    code = "import numpy as np; from msgs_slam.pipelines.render.cpu_bands import list_tiles; "
    code += "starts, members = list_tiles(np.array([20, 5, 1, 1, 0.5, 3], np.float32), 0, 40, 16); "
    code += "assert starts.tolist() == [0, 0, 1, 1]; print(sum(list_tiles.stats.cache_hits.values()))"
    environment = {**os.environ, "HOME": "/dev/null", "TMPDIR": str(tmp_path)}
    for hits in ("0", "1"):
        done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert done.stdout.strip() == hits
        assert done.stderr.count("compiled kernels are kept in") == 1
