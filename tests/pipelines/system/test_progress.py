"""What is told of a run while it goes on: stages, bars, and the time left."""

import io
import sys
from collections.abc import Callable, Iterator

import pytest

from msgs_slam.msgs_cli.output import BarProgress
from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.run.progress import TimeLeft
from msgs_slam.pipelines.system.progress import (
    BEGUN,
    ENDED,
    UP_TO_DATE,
    LineProgress,
    SilentProgress,
    StageEvent,
    WithinStage,
    about,
    between,
)


def event(state: str, left: Callable[[], float | None] = lambda: 240.0) -> StageEvent:
    return StageEvent("proxy", 2, 6, state, 96.4, {"classes": 6}, left)


def test_time_left_follows_what_stages_have_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    left = TimeLeft({}, STAGES)
    left.begin("frames")
    assert left.left() is None, "nothing is known of this machine yet"
    left.end("frames", 20.0, {})
    assert left.left() == pytest.approx(80.0), "frames are 20 of 100"
    left.begin("proxy")
    now[0] = 23.0
    assert left.left() == pytest.approx(80.0 - 23.0)
    now[0] = 1000.0
    assert left.left() == pytest.approx(80.0 - 28.0 + 2.8), "late, and not over yet"
    left.end("proxy", 56.0, {})
    assert left.left() == pytest.approx(52.0 * (56 + 10) / (28 + 10)), "slower than thought, so is the rest"
    left.begin("tracking")
    left.end("tracking", 5.0, {"posed": 100, "pieces": [30, 20]})
    assert left.left() == pytest.approx((47 + 0.5 * 80) * (5 + 28 + 5) / (5 + 14 + 5)), "pieces are whole runs"
    resumed = TimeLeft({"frames": 40.0, "proxy": 56.0, "tracking": 10.0}, ("frames", "proxy", "tracking"))
    assert resumed.left() == 0
    resumed.begin("proxy")
    assert resumed.left() == pytest.approx(2 * (28 + 5)), "what is made again does not count as done"
    draft = TimeLeft({"frames": 38.0}, STAGES, is_draft=True)
    draft.begin("proxy")
    assert draft.left() == pytest.approx(62.5)


def test_words_for_a_time() -> None:
    assert [about(s) for s in (3, 44, 100, 240, 5000, 9000)] == [
        "about 10 s", "about 40 s", "about 2 min", "about 4 min", "about 83 min", "about 2 h"
    ]  # fmt: skip


def test_a_first_guess_is_a_range() -> None:
    assert [between(s / 2, 2 * s) for s in (3, 44, 100, 240, 5000)] == [
        "about 10 s", "20 to 90 s", "1 to 3 min", "2 to 8 min", "1 to 3 h"
    ]  # fmt: skip


def test_bars_name_their_stage_and_close_at_their_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    bars = BarProgress()
    bars.stage(event(BEGUN))

    def two_of_five() -> Iterator[int]:
        yield from (1, 2)

    assert list(bars.track(two_of_five(), "depth", 5)) == [1, 2]
    for item in bars.track(range(4), "camera model", 4):
        if item == 1:
            break
    bars.stage(event(ENDED))
    bars.stage(event(UP_TO_DATE))
    said = sys.stderr.getvalue()  # type: ignore[attr-defined]
    last = [piece for piece in said.replace("\n", "\r").split("\r") if "|" in piece]
    title = "[2/6 depth and classes]"
    assert any(piece.startswith(f"{title} depth") and "100%" in piece and "2/2" in piece for piece in last)
    assert "2 to 8 min to the end" in said, "one stage has ended: a guess"
    assert "[2/6 depth and classes] camera model" in said
    assert "100%" in last[-1]
    assert "[2/6 depth and classes] done in 96 s; 3 to 5 min left" in said
    assert "[2/6 depth and classes] up to date" in said


def test_lines_are_a_stage_each(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    lines = LineProgress("room")
    lines.stage(event(BEGUN))
    assert list(lines.track(range(3), "depth", 3)) == [0, 1, 2]
    lines.stage(event(ENDED))
    assert capsys.readouterr().err == "room: [2/6 depth and classes] done in 96 s; 3 to 5 min left\n"
    lines.stage(event(BEGUN))
    for _ in lines.track(range(3), "depth", 3):
        now[0] += 400
    assert capsys.readouterr().err == "room: [2/6 depth and classes] depth 2 of 3\n", "a sign of life"


def test_a_run_within_a_stage_is_work_of_that_stage() -> None:
    class Heard(SilentProgress):
        said: list[str] = []  # noqa: RUF012

        def track(self, items, label, total=None):  # type: ignore[no-untyped-def]
            self.said.append(label)
            yield from items

        def stage(self, event: StageEvent) -> None:
            self.said.append(event.name)

    inside = WithinStage(Heard(), "piece_2")
    inside.stage(event(BEGUN))
    assert list(inside.track([1], "depth")) == [1]
    assert Heard.said == ["piece_2: depth"]
