"""Everything is installed under one name, msgs_slam; the folders of the sources stay where they are.

`pipelines` and `formats` at the top of site-packages would collide with the first other package of such a name. The
built copies lie in msgs_slam/ and import each other as msgs_slam.pipelines and so on; the sources need not know. An
editable install uses the sources as they are, with the names that they have there.
"""

import re
import shutil
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

NAME, ROOMS = "msgs_slam", ("msgs_cli", "pipelines", "formats")
FACE = "msgs_cli.msgs_slam"
IMPORT = re.compile(rf"^(\s*)(from|import) ({'|'.join(ROOMS)})(?=[\s.])", re.MULTILINE)


class UnderOneName(build_py):
    """Builds as always, then moves the rooms into the package and turns their imports."""

    def run(self) -> None:
        """The whole build of the Python files."""
        super().run()
        if self.editable_mode:
            return
        built = Path(self.build_lib)
        for room in ROOMS:
            shutil.rmtree(built / NAME / room, ignore_errors=True)
            shutil.move(built / room, built / NAME / room)
        for path in (built / NAME).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            path.write_text(IMPORT.sub(rf"\1\2 {NAME}.\3", text), encoding="utf-8")


setup(
    packages=[NAME, *find_packages(include=[p for r in ROOMS for p in (r, f"{r}.*")], exclude=[FACE])],
    package_dir={NAME: FACE.replace(".", "/")},
    cmdclass={"build_py": UnderOneName},
)
