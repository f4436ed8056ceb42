"""Work shared out among processes: in order, and nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from synthetless.io.parallel import each, processes, usable_cores

ROOT = Path(__file__).resolve().parents[2]


def _square(number: int) -> int:
    time.sleep(0.02 * (number % 3))  # so that they would end in another order
    return number * number


def _where(_: int) -> int:
    return os.getpid()


def _refuse_three(number: int) -> int:
    if number == 3:
        raise ValueError(f"{number} is too many")
    return number


def _die(number: int) -> int:
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_tasks_order(workers: int) -> None:
    assert list(each(_square, range(12), workers, "squares", "square")) == [n * n for n in range(12)]
    with processes(workers, 12) as run:
        assert list(run(_square, range(12), chunksize=5)) == [n * n for n in range(12)]


def test_no_process_is_started_for_a_single_task() -> None:
    assert list(each(_where, [0], 8, "places", "place")) == [os.getpid()]
    assert list(each(_where, [], None, "places", "place")) == []


def test_one_process_for_each_core_at_most() -> None:
    seen = set(each(_where, range(40), None, "places", "place"))
    assert len(seen) <= usable_cores()
    assert usable_cores() == 1 or os.getpid() not in seen


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_is_told_as_it_was_raised(workers: int) -> None:
    with pytest.raises(ValueError, match="3 is too many"):
        list(each(_refuse_three, range(20), workers, "numbers", "number"))


def test_a_killed_process_is_told_in_one_line() -> None:
    with pytest.raises(ChildProcessError, match="was killed"):
        list(each(_die, range(6), 2, "numbers", "number"))


@pytest.mark.parametrize("age_s", [0.0, 0.1, 0.3, 1.0])
def test_processes_killed_while_they_start_are_told_in_one_line(age_s: float) -> None:
    """Every one of them, as soon as it is so old."""
    ended = threading.Event()

    def kill() -> None:
        while not ended.wait(0.01):
            for child in psutil.Process().children():
                with suppress(psutil.NoSuchProcess):
                    if time.time() - child.create_time() >= age_s and "spawn_main" in " ".join(child.cmdline()):
                        child.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        with pytest.raises(ChildProcessError, match="was killed"), processes(2, 2) as run:
            for _ in range(100):
                list(run(_square, range(12)))
    finally:
        ended.set()
        killer.join()


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_the_one_that_started_it(end: signal.Signals, tmp_path: Path) -> None:
    """Killed, it leaves orphans, who stop after their task; at Ctrl-C it does not wait for tasks to end."""
    seconds = 600 if end == signal.SIGINT else 0.5
    script = tmp_path / "script.py"
    script.write_text(
        "import time\n"
        "from synthetless.io.parallel import processes\n"
        "if __name__ == '__main__':\n"
        "    with processes(2, 2) as run:\n"
        "        for _ in run(time.sleep, [0, 0]): pass\n"
        "        print('begun', flush=True)\n"
        f"        for _ in run(time.sleep, [{seconds}] * 2000): pass\n"
    )
    parent = subprocess.Popen(
        [sys.executable, script],
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout is not None
    assert parent.stdout.readline() == "begun\n"
    children = psutil.Process(parent.pid).children(recursive=True)
    assert len(children) >= 2
    time.sleep(0.5)  # into the tasks
    parent.send_signal(end)
    _, errors = parent.communicate(timeout=60)
    assert errors.count("KeyboardInterrupt") == (end == signal.SIGINT), "of the parent alone"
    assert psutil.wait_procs(children, timeout=60)[1] == []
