"""The report on paper, by a browser of this machine."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from ...formats.atomic import atomic_path
from ...formats.errors import InputError

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge")
_SECONDS = 300


def find_browser() -> str:
    """The browser to print with. Raises InputError where there is none."""
    for name in BROWSERS:
        if found := shutil.which(name):
            return found
    raise InputError(
        "a PDF needs a browser of the Chromium family, and none is in the PATH: install chromium, or open the HTML "
        "report in any browser and print it there"
    )


def print_pdf(page: Path, target: Path, browser: str) -> None:
    """Print an HTML file. Raises InputError with the browser's own words where it cannot."""
    with atomic_path(target) as temporary, tempfile.TemporaryDirectory() as profile:
        command = [browser, "--headless=new", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer"]
        command += ["--no-sandbox"] if os.geteuid() == 0 else []  # it does not start as root with one
        command += [f"--user-data-dir={profile}", f"--print-to-pdf={temporary}", page.resolve().as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS)
        except subprocess.TimeoutExpired as error:
            raise InputError(f"{browser} took over {_SECONDS} s to print {page}: open it and print it there") from error
        if done.returncode or not temporary.exists():
            said = done.stderr.strip()[-300:]
            raise InputError(f"{browser} could not print {page} ({said}): open it and print it there")
