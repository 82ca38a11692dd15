"""The report on paper: refused before the work where no browser is, printed where one is."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from msgs_slam.formats.errors import InputError
from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.evaluation.html import BROWSERS, print_pdf
from msgs_slam.pipelines.run.folder import RunFolder


def test_without_a_browser_nothing_is_drawn(
    oracle_run: Callable[..., RunFolder], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = oracle_run()
    monkeypatch.setenv("PATH", str(tmp_path))
    done = CliRunner().invoke(main, ["report", str(run.root), "--pdf"])
    assert done.exit_code == 1
    assert "install chromium" in done.output
    assert not run.report_file.exists()


@pytest.mark.skipif(not any(map(shutil.which, BROWSERS)), reason="no browser is installed here to print with")
def test_a_page_becomes_a_pdf(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text("<p>one</p><p style='break-before: page'>two</p>")
    browser = next(found for name in BROWSERS if (found := shutil.which(name)))
    print_pdf(tmp_path / "page.html", tmp_path / "page.pdf", browser)
    assert (tmp_path / "page.pdf").read_bytes().startswith(b"%PDF-")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page.html", "page.pdf"]


def test_a_browser_that_fails_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text("<p>one</p>")
    false = shutil.which("false")
    assert false is not None
    assert subprocess.run([false]).returncode
    with pytest.raises(InputError, match="could not print"):
        print_pdf(tmp_path / "page.html", tmp_path / "page.pdf", false)
    assert not (tmp_path / "page.pdf").exists()
