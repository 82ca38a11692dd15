"""Before a release: give every stage whose sources have changed since the last one a new number.

    python tests/release.py [--same mapping ...]

Writes pipelines/system/stage_versions.toml for the version in pyproject.toml. A stage named with --same keeps its
number: say so only where its results are known to be the same bytes, for users keep what an older release has made.
"""

import argparse
import tomllib
from pathlib import Path

from msgs_slam.formats.atomic import write_text
from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.system.identity import ROOT, TABLE, source_digest

PYPROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def main() -> None:
    """See the top of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--same", nargs="*", default=[], choices=STAGES)
    same = parser.parse_args().same
    text = TABLE.read_text(encoding="utf-8")
    before = tomllib.loads(text)
    version = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]["version"]
    lines = [text.splitlines()[0], f'release = "{version}"']
    for name in STAGES:
        sources = source_digest(ROOT / "pipelines" / name / "stage.py")
        number = before[name]["number"] + (sources != before[name]["sources"] and name not in same)
        lines += ["", f"[{name}]", f"number = {number}", f'sources = "{sources}"']
    write_text(TABLE, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
