"""Work on many things of a kind, shared out among the cores of this machine."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, connection, get_context, parent_process, resource_tracker
from types import ModuleType
from typing import Protocol, TypeVar

from tqdm import tqdm

Task = TypeVar("Task")
Result = TypeVar("Result")


class Map(Protocol):
    """Calls a function with every task; the results come in the tasks' order, each as soon as it can."""

    def __call__(
        self, function: Callable[[Task], Result], tasks: Sequence[Task], chunksize: int = 1
    ) -> Iterator[Result]: ...


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def processes(wanted: int | None, most: int) -> Iterator[Map]:
    """Start processes for the duration, and give the ``map`` that shares work out among them.

    They are spawned, and do not import the script that gets here; functions and tasks come from modules. None outlives
    this process.

    Args:
        wanted: how many; one per core if None.
        most: how many have something to do. If that is only one, it is this process.

    Raises:
        ChildProcessError: one of them was killed.
    """
    count = min(wanted or usable_cores(), most)
    if count <= 1:
        yield lambda function, tasks, chunksize=1: map(function, tasks)
        return
    others = set(active_children())
    pool = ProcessPoolExecutor(count, get_context("spawn"), _prepare)

    def map_in_pool(function: Callable[[Task], Result], tasks: Sequence[Task], chunksize: int = 1) -> Iterator[Result]:
        with without_interrupts(), without_script():  # the processes are started here
            return pool.map(function, tasks, chunksize=chunksize)

    try:
        yield map_in_pool
        pool.shutdown()
    except BaseException as error:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(active_children()) - others:
            process.kill()  # or whoever pressed Ctrl-C would wait for the tasks that are under way
        if isinstance(error, BrokenProcessPool):
            told = "a worker process was killed, perhaps for lack of memory; run it again"
            raise ChildProcessError(told) from None
        raise


def each(
    function: Callable[[Task], Result], tasks: Sequence[Task], workers: int | None, what: str, unit: str
) -> Iterator[Result]:
    """The function's results in the tasks' order, with a progress bar; ``workers`` and errors as in ``processes``."""
    with processes(workers, len(tasks)) as run:
        yield from watched(run, function, tasks, what, unit)


def watched(
    run: Map, function: Callable[[Task], Result], tasks: Sequence[Task], what: str, unit: str
) -> Iterator[Result]:
    """``run(function, tasks)`` with a progress bar."""
    return iter(tqdm(run(function, tasks), total=len(tasks), desc=what, unit=unit, disable=None))


@contextmanager
def without_interrupts() -> Iterator[None]:
    """Processes that are started meanwhile never see Ctrl-C, which is for this one to answer, afterwards."""
    resource_tracker.ensure_running()  # the first start of a process would start it, and let interrupts in again
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


@contextmanager
def without_script() -> Iterator[None]:
    """Processes that are spawned meanwhile do not import ``__main__``.

    A script without ``if __name__ == "__main__"`` would do in each of them what it does, and the fault would be theirs.
    """
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


def _prepare() -> None:
    """In each process: end with the one that started it, however that ends; its pipes alone do not tell."""
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)
