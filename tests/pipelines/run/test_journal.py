"""What several machines have written into a stage's folder is known afterwards, on a network disk too."""

from pathlib import Path

import pytest

from msgs_slam.formats.atomic import watched_by, write_text
from msgs_slam.pipelines.run.ending import results
from msgs_slam.pipelines.run.journal import JOURNAL, Journal


def contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def restore(folder: Path, files: dict[str, bytes]) -> None:
    for path in folder.iterdir():
        path.unlink()
    for name, data in files.items():
        (folder / name).write_bytes(data)


def test_lines_of_two_machines_do_not_overwrite_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over NFS appending is no atomic act (open(2)): each client writes where the file ended when it last looked, and
    of a file that both have changed one version stays."""

    def write_from(node: str) -> None:
        monkeypatch.setattr("platform.node", lambda: node)
        with watched_by(Journal(tmp_path)):
            write_text(tmp_path / f"{node}.txt", f"what {node} found")

    write_from("first")  # both have looked
    write_from("second")
    seen = contents(tmp_path)
    write_from("third")
    of_third = contents(tmp_path)
    restore(tmp_path, seen)
    write_from("fourth")
    restore(tmp_path, of_third | contents(tmp_path))

    journal = Journal(tmp_path)
    assert journal.discard_damaged() == []
    assert sorted(p.name for p in tmp_path.glob("*.txt")) == ["first.txt", "fourth.txt", "second.txt", "third.txt"]
    journal.check(results(tmp_path))


def test_the_journal_of_an_earlier_version_still_counts(tmp_path: Path) -> None:
    with watched_by(Journal(tmp_path)):
        write_text(tmp_path / "a.txt", "a")
    (mine,) = Journal(tmp_path).files()
    mine.rename(tmp_path / JOURNAL)
    assert Journal(tmp_path).discard_damaged() == []
    assert (tmp_path / "a.txt").exists()
