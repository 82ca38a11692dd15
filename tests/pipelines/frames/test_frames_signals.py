"""A process that is asked to end does so, without a stack trace of pycolmap's."""

import signal
import subprocess
import sys

import pytest

SETUP = {
    "default": ("", -signal.SIGTERM, ""),
    "handler": ("signal.signal(signal.SIGTERM, lambda *_: sys.exit('asked to end'))", 1, "asked to end\n"),
}


@pytest.mark.parametrize("before", SETUP)
def test_sigterm_ends_quietly(before: str) -> None:
    setup, code, said = SETUP[before]
    script = f"import os, signal, sys\n{setup}\n"
    script += "import msgs_slam.pipelines.frames.stage\nos.kill(os.getpid(), signal.SIGTERM)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (code, said)
