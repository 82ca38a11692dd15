"""`msgs_slam.formats` is a library of its own: what importing it loads."""

import pkgutil
import subprocess
import sys

import pytest

from msgs_slam import formats

LOADED = "import sys; import {}; print(*{{n.partition('.')[0] for n in sys.modules if sys.modules[n]}})"
MODULES = [found.name for found in pkgutil.walk_packages(formats.__path__, "msgs_slam.formats.")]
ARRAYS_ONLY = ("colmap", "ply", "poses", "trajectory")


def loaded_by(*names: str) -> set[str]:
    """Top-level packages outside of Python's own that an import brings into a new process."""
    done = subprocess.run(
        [sys.executable, "-S", "-c", f"import sys; sys.path[:] = {sys.path!r}; " + LOADED.format(", ".join(names))],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return set(done.stdout.split()) - set(sys.stdlib_module_names) - {"__main__", "msgs_slam"}


def test_all_of_it_loads_nothing_that_computes() -> None:
    assert len(MODULES) > 20
    assert {"numpy", "cv2", "PIL"} <= (loaded := loaded_by(*MODULES))
    assert not loaded & {"torch", "numba", "scipy", "pycolmap", "onnxruntime", "skimage", "trimesh", "click", "tqdm"}


@pytest.mark.parametrize("name", ARRAYS_ONLY)
def test_tables_of_numbers_need_numpy_alone(name: str) -> None:
    assert loaded_by(f"msgs_slam.formats.{name}") == {"numpy"}


def test_no_other_room_is_loaded() -> None:
    names = ", ".join(MODULES)
    script = f"import sys, {names}; assert not [n for n in sys.modules if n.startswith('msgs_slam.pipelines')]"
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)
