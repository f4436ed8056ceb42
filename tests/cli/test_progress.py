"""What is told of a run while it lasts: in a terminal, in a log, to a scheduler."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Sequence
from typing import TextIO

import pytest
from hypothesis import given
from hypothesis import strategies as st

from synthetless.cli.progress import display
from synthetless.generation.progress import (
    COLLIDERS,
    DONE,
    DROPPING,
    RENDERING,
    STARTING,
    Progress,
    Stage,
    Tracker,
    Work,
)


class Clock:
    """A clock that stands until it is put forward."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def _run(work: Sequence[tuple[float, Sequence[Work]]], wanted: int = 4) -> tuple[Tracker, list[Progress], Clock]:
    told: list[Progress] = []
    now = Clock()
    tracker = Tracker(told.append, now)
    tracker.want(wanted)
    for seconds, each in work:
        now.now += seconds
        tracker.watch(each)
    return tracker, told, now


def test_the_phases_are_told_before_the_first_image() -> None:
    stages = [Stage(STARTING), Stage(COLLIDERS, "2 of 3"), Stage(DROPPING), Stage(RENDERING, "1 of 2", 1 / 3)]
    _, told, _ = _run([(1.0, [Work(stage, 0 if stage.name == STARTING else 2)]) for stage in stages])
    assert [each.phase for each in told] == [stage.name for stage in stages]
    assert told[1].doing == "preparing colliders 2 of 3"
    assert all(each.images_per_hour is None and each.left_s is None for each in told)
    assert told[-1].share == pytest.approx(2 / 3 / 4), "it moves within a drop"


def test_rate_and_time_left() -> None:
    """Two images in 10 s of work; starting Blender took 30 s and does not count."""
    tracker, told, now = _run([(30.0, [Work(Stage(STARTING))]), (0.0, [Work(Stage(COLLIDERS), 2)])])
    now.now += 10
    tracker.ended(2, 2, failed=False)
    tracker.watch([Work(Stage(DROPPING), 2), Work(Stage(RENDERING), 2)])
    assert told[-1].images_per_hour == pytest.approx(720)
    assert told[-1].left_s == pytest.approx(10)
    assert told[-1].elapsed_s == pytest.approx(40)
    assert told[-1].doing == "rendering (1), dropping objects (1)"
    now.now += 10
    tracker.ended(2, 1, failed=True)
    tracker.phase(DONE)
    assert (told[-1].images, told[-1].failed_drops, told[-1].share, told[-1].left_s) == (3, 1, 1.0, 0)


@given(st.lists(st.tuples(st.floats(0, 1e5), st.integers(1, 9), st.floats(0, 1)), min_size=1, max_size=200))
def test_shares_are_shares_and_times_no_less_than_nothing(drops: list[tuple[float, int, float]]) -> None:
    tracker, told, now = _run([(0.0, [Work(Stage(COLLIDERS), 1)])], wanted=sum(images for _, images, _ in drops))
    for seconds, images, share in drops:
        tracker.watch([Work(Stage(RENDERING, share=share), images)])
        now.now += seconds
        tracker.ended(images, images, failed=False)
        tracker.watch([])
    assert all(0 <= each.share <= 1 and (each.left_s is None or each.left_s >= 0) for each in told)
    assert told[-1].share == pytest.approx(1)


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def _shown(as_json: bool, stderr: TextIO, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(sys, "stderr", stderr)
    with display(as_json) as tell:
        for share in (0.25, 0.5):
            for doing in ("rendering 1 of 2", "rendering 2 of 2"):
                tell(Progress("making images", doing, 5, 12, share, 1, 60.0, 300.0, 84.0))
    return stderr.getvalue() if isinstance(stderr, io.StringIO) else ""


def test_a_log_gets_a_line_for_a_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    told = _shown(False, io.StringIO(), monkeypatch)
    assert told == "5 of 12 images, 300 an hour, 1:24 left, 1 failed drop: rendering 1 of 2\n"


def test_a_terminal_gets_a_bar_that_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "140")
    told = _shown(False, _Terminal(), monkeypatch)
    assert " 50%|" in told
    assert "rendering 2 of 2" in told
    assert "\n" not in told


def test_a_terminal_without_a_size_gets_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """A real one, as Docker gives it where its own has no size: a bar would not be drawn at all."""
    reading, writing = os.openpty()
    with os.fdopen(writing, "w") as terminal:
        assert terminal.isatty()
        _shown(False, terminal, monkeypatch)
        assert b"rendering 1 of 2" in os.read(reading, 1000)
    os.close(reading)


def test_a_scheduler_gets_json(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = _shown(True, io.StringIO(), monkeypatch).splitlines()
    assert json.loads(line)["images_per_hour"] == 300
    assert json.loads(line)["phase"] == "making images"


@pytest.mark.parametrize(
    ("seconds", "shown"), [(0, "0:00"), (0.2, "0:01"), (84, "1:24"), (3600, "1:00:00"), (1e6, "277:46:40")]
)
def test_how_times_are_written(seconds: float, shown: str) -> None:
    told = Progress("making images", "rendering", 1, 2, images_per_hour=60.0, left_s=seconds)
    assert str(told) == f"1 of 2 images, 60 an hour, {shown} left: rendering"
