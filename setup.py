"""The list of packages: the folders of the repository, installed as one package `msgs_slam`.

`package_dir` gives each folder its one import name, the same in an editable install and in a wheel. It is not written
in pyproject.toml because the list of packages cannot be found automatically under other names.
"""

from setuptools import find_packages, setup

FOLDERS = {"msgs_slam": "msgs_cli/msgs_slam"} | {f"msgs_slam.{n}": n for n in ("msgs_cli", "pipelines", "formats")}

setup(
    packages=[
        *FOLDERS,
        *(f"{name}.{sub}" for name, folder in FOLDERS.items() for sub in find_packages(folder, exclude=["msgs_slam"])),
    ],
    package_dir=FOLDERS,
    data_files=[("share/man/man1", ["docs/msgs-slam.1"])],
    package_data={"msgs_slam.pipelines": ["**/*.toml", "**/*.json", "demo_clip/*", "export/page/*"]},
)
