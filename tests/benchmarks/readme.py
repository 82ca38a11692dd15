"""Every line of the README's blocks for the shell, in order, in a fresh clone: what each took, or how it ended.

    python tests/benchmarks/readme.py [--work DIR] [--skip 'make test' ...]

The user's video is the demo's clip, the second one its later half, the data set the demo's truth; a line that starts a
server is interrupted after a while. Programs of others are left out. Ten CPU minutes, and half an hour for `make test`.
"""

import argparse
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
OTHERS = ("brush", "ns-train", "opensplat")
SERVES = ("msgs-slam view",)
FILES = """
import shutil, sys
from pathlib import Path
from msgs_slam.formats.video import VideoReader
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.evaluation.write import CLIP, VIDEO
here = Path(sys.argv[1])
shutil.copy(CLIP / VIDEO, here / "video.mp4")
write_video(here / "more.mp4", (frame.rgb for k, frame in enumerate(VideoReader(CLIP / VIDEO)) if k >= 12), 10.0)
"""


def lines() -> list[str]:
    """Of all blocks, without what explains them."""
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    return [line for block in blocks for row in block.splitlines() if (line := re.sub(r"\s+#.*", "", row).strip())]


def script(skipped: list[str]) -> str:
    """One for bash, which says before each line what it is and after it how long it took, and goes on."""
    known = {"ADDRESS": shlex.quote(str(ROOT)), "DATASET": "msgs-demo/room_truth"}
    out = []
    for line in lines():
        if line in skipped or line.split()[0] in OTHERS:
            out.append(f"echo {shlex.quote('left out: ' + line)}")
            continue
        real = re.sub("|".join(known), lambda word: known[word[0]], line)
        real = f"timeout -s INT 20 {real}; [ $? -eq 124 ]" if line.startswith(SERVES) else real
        report = f'echo "$? after $((SECONDS - s)) s: "{shlex.quote(line)}'
        out.append(f"s=$SECONDS; {{ {real}; }} >> lines.log 2>&1; {report}")
        if line.startswith("make demo"):
            out.append(f".venv/bin/python -c {shlex.quote(FILES)} .")
    return "\n".join(out)


def main() -> None:
    """Print a line for each; the status is 1 where one failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, help="an empty folder for the clone")
    parser.add_argument("--skip", nargs="*", default=[], metavar="LINE")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        bash = ["bash", "-c", script(given.skip)]
        done = subprocess.run(bash, cwd=given.work or scratch, stdout=subprocess.PIPE, text=True)
        print(done.stdout, end="")
    sys.exit(any(not row.startswith(("0 after", "left out")) for row in done.stdout.splitlines()))


if __name__ == "__main__":
    main()
