"""The packages: msgs_slam/ and the folders that it links to are one, whatever else lies beside. pyproject.toml, which
says all else, cannot say where they lie in a checkout without links, as Git for Windows makes it.
"""

from pathlib import Path

from setuptools import find_packages, setup

ROOMS = ("formats", "msgs_cli", "pipelines")
if all(Path("msgs_slam", room).is_dir() for room in ROOMS):  # links, or the copies of a source distribution
    # A path alone: of it an editable install is made that editors read too.
    setup(packages=find_packages(".", include=["msgs_slam", "msgs_slam.*"]), package_dir={"": "."})
else:
    inner = find_packages(".", include=[f"{room}{below}" for room in ROOMS for below in ("", ".*")])
    places = {"": "."} | {f"msgs_slam.{room}": room for room in ROOMS}
    setup(packages=["msgs_slam", *(f"msgs_slam.{name}" for name in inner)], package_dir=places)
