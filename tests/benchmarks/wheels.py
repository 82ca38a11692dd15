"""Whether every dependency has a wheel for Windows and for Macs: asks the package index, installs nothing."""

import argparse
import subprocess
import sys
import tomllib
from pathlib import Path

SYSTEMS = ("win_amd64", "macosx_14_0_arm64")
VERSIONS = ("3.11", "3.12", "3.13")
PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"


def is_there(requirement: str, system: str, version: str) -> bool:
    """Ask pip for a wheel that fits; without what it depends on itself."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--no-deps", "--only-binary=:all:"]
    command += ["--target", "none", "--platform", system, "--python-version", version, requirement]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def main() -> None:
    """Print a row for each system and version, with what lacks a wheel there."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    extras = [r for name in ("words", "hdr", "usd", "lpips") for r in project["optional-dependencies"][name]]
    for system in SYSTEMS:
        for version in VERSIONS:
            lacking = [r for r in (*project["dependencies"], *extras) if not is_there(r, system, version)]
            print(f"{system} {version}: {', '.join(lacking) or 'all'}", flush=True)


if __name__ == "__main__":
    main()
