"""`msgs-slam models` through click's runner, over a cache of the test's own."""

from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.networks import registry
from msgs_slam.pipelines.networks.registry import ModelStore
from tests.networks import save_network


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MSGS_SLAM_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as for an unknown user without HOME
    said = CliRunner().invoke(main, ["models", "list"])
    assert said.exit_code == 1
    assert "set MSGS_SLAM_CACHE" in said.output
    assert isinstance(said.exception, SystemExit)


def models(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["models", *map(str, arguments)])


def write_network(path: Path, output: str) -> Path:
    mean = f"{output} = ReduceMean <axes = [1], keepdims = 0> (pixel_values)"
    return save_network(path, "float[1, 3, h, w] pixel_values", f"float[1, h, w] {output}", mean)


def test_list_says_size_licence_and_what_is_not_pinned(cache: Path) -> None:
    lines = models("list").stdout.splitlines()
    assert max(map(len, lines[:-1])) <= 100
    rows: dict[str, str] = {}
    for line in lines:  # the last column goes on below
        name = list(rows)[-1] if line.startswith(" ") else line.split()[0]
        rows[name] = " ".join([*rows.get(name, "").split(), *line.split()])
    assert "75.8 MB" in rows["metric3d-small"]
    assert "e-mailed" in rows["metric3d-small"]
    assert "revision" not in rows["metric3d-small"]
    assert "no fixed revision" in rows["metric3d-large"]
    assert "size unknown" in rows["dinov2-small-head"]
    assert "--trust" in rows["dinov2-small-head"]
    assert str(cache) in lines[-1]
    assert "aliked-n16rot" in rows
    assert "aliked-n16rot-export" not in rows, "it has no address, and is not here"


def test_pull_without_a_network_says_what_to_do_and_asks_for_the_licence_first(cache: Path) -> None:
    offline = models("pull", "--offline")
    assert offline.exit_code == 1
    assert "ade20k-small is not in" in offline.stderr
    assert "moge2-small is not in" in models("pull", "--best", "--offline").stderr
    assert "--trust" not in models("pull", "--best", "--yes", "--offline").stderr
    refused = CliRunner().invoke(main, ["models", "pull", "moge2-small"], input="n\n")
    assert refused.exit_code == 1
    assert "licence: MIT" in refused.output
    unknown = models("pull", "person", "dinov2-small", "--yes")
    assert unknown.exit_code == 1
    assert "dinov2-small-head: nobody has published its sha256" in unknown.stderr, "before the first byte"
    assert "--trust" in unknown.stderr
    assert not cache.exists() or not list(cache.glob("*.onnx"))


@pytest.mark.parametrize("words", [[], ["--best"]])
def test_what_the_program_recommends_can_be_pulled(
    words: list[str], cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every file of these pulls has a size and a hash, so that all arrive where the addresses deliver."""
    fetched = []

    def deliver(urls: tuple[str, ...], target: Path, size: int, sha256: str, progress: object) -> str:
        assert size > 0
        assert len(sha256) == 64
        fetched.append(target.stem)
        return sha256

    monkeypatch.setattr(registry, "fetch", deliver)
    done = models("pull", "--yes", *words)
    assert done.exit_code == 0, done.output
    assert {"ade20k-small", "fast-depth", "person"} <= set(fetched)
    assert ("moge2-small" in fetched) == bool(words)


def test_files_of_a_folder_are_taken_by_their_content(cache: Path, tmp_path: Path, shared_data: Path) -> None:
    (tmp_path / "empty").mkdir()
    nothing = models("pull", "--from", tmp_path / "empty")
    assert nothing.exit_code == 1
    assert "holds no file of metric3d-small, moge2-s" in nothing.stderr
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "whatever.bin").write_bytes(
        (shared_data / "models" / "selfie_segmentation.tflite").read_bytes()
    )
    lacking = models("pull", "person", "fast-depth", "--from", tmp_path / "mine")
    assert "holds no file of fast-depth" in lacking.stderr
    assert models("pull", "--from", tmp_path / "mine").stdout.strip() == str(cache / "person.tflite")
    assert "here" in next(line for line in models("list").stdout.splitlines() if line.startswith("person"))
    assert models("path", "person").exit_code == 0


def test_own_networks_are_added_checked_and_found(cache: Path, tmp_path: Path) -> None:
    wrong = models("add", write_network(tmp_path / "net.onnx", "depths"), "--family", "metric3d-community")
    assert wrong.exit_code == 1
    assert "no output 'predicted_depth'" in wrong.stderr
    right = models("add", write_network(tmp_path / "net.onnx", "predicted_depth"), "--family", "metric3d-community")
    assert right.exit_code == 0, right.output
    assert models("path", "net").stdout.strip() == str(cache / "net.onnx")
    assert models("verify").exit_code == 0
    with ModelStore.open().path(ModelStore.open().get("net")).open("ab") as stream:
        stream.write(b"?")
    damaged = models("verify")
    assert damaged.exit_code == 1
    assert "damaged" in damaged.stdout
    assert models("path", "moge2-small").exit_code == 1
