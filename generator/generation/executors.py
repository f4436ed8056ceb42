"""Makes drops in worker processes, which may die, hang or grow without taking the rest of the dataset with them.

Each worker has a pipe of its own and never more than one drop. So it is always known which drop a dead worker was at,
and nothing that it held can block the others: pools that share one queue lose a task, or break, when a worker is killed
at the wrong moment.
"""

from __future__ import annotations

import os
import platform
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import count, islice
from multiprocessing import connection, get_context
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

import psutil

from synthetless.config import Recipe
from synthetless.dataset.layout import LOGS_FOLDER, ImagePlan
from synthetless.dataset.store import DatasetError, DatasetStore, FinishedImage
from synthetless.errors import UserError
from synthetless.generation import devices
from synthetless.generation.devices import CPU, Devices
from synthetless.generation.drop import DropFailed, DropRenderer
from synthetless.generation.progress import COLLIDERS, STARTING, Report, Stage, Work, unreported
from synthetless.generation.sources import Sources, load_sources
from synthetless.io.parallel import without_interrupts, without_script
from synthetless.scenes.blender import BlenderError, RenderDevice, console_to

FAULT_VARIABLE = "SYNTHETLESS_FAULTS"
"""For tests of what survives: "abort:3,hang:5" lets drop 3 kill its worker and drop 5 never end."""

_GROWTH_LIMIT_BYTES = 1.5e9
"""A worker that has grown by so much is replaced."""
_EXIT_NO_MEMORY = 75
_DEATHS = 2
"""A drop over which so many workers died is given up."""
_DEATHS_AT_START = 12
"""The run ends when so many workers have died while starting, one after the other, and none got through."""
_START_LIMIT_S = 120.0
"""A worker that has not started after so long is ended; OpenBLAS, for one, waits for ever where there is no memory."""
_HANGS_AT_START = 2
"""The run ends after so many of them, too."""
_END_LIMIT_S = 10.0
"""How long a worker without work may take to end."""
_TICK_S = 1.0
"""How often the time limits are checked."""


_START = Stage(STARTING)


@dataclass(frozen=True)
class DropTask:
    """The images wanted of one drop."""

    drop: int
    images: tuple[ImagePlan, ...]


@dataclass(frozen=True)
class DropResult:
    """What became of a task.

    Attributes:
        task: which one.
        made: how many images were made.
        failure: why some are missing, "" if none are.
        killed: whether the worker died over it.
        images: those of the made ones that are still to be committed.
        outgrown: whether the worker's memory has grown so much that it should be replaced.
    """

    task: DropTask
    made: int = 0
    failure: str = ""
    killed: bool = False
    images: tuple[FinishedImage, ...] = ()
    outgrown: bool = False


@dataclass(frozen=True)
class WorkerConfig:
    """What a worker needs to know.

    Attributes:
        recipe: what to make.
        root: the dataset's folder.
        threads: of the renderer, for each worker; 0 uses every core.
        drop_limit_s: a drop that takes longer counts as hung.
        devices: what to render on; each worker takes one of the GPUs.
    """

    recipe: Recipe
    root: Path
    threads: int
    drop_limit_s: float
    devices: Devices = CPU


class DropWorker:
    """Makes drops, one after the other, in a process of its own: the same on this machine and on a cluster."""

    def __init__(self, config: WorkerConfig, sources: Sources, device: RenderDevice, log: Path) -> None:
        """Load what all drops share, and start Blender, which from then on prints to ``log``."""
        self._renderer = DropRenderer(config.recipe, sources, config.threads, device, log)
        self._memory_limit = psutil.Process().memory_info().rss + _GROWTH_LIMIT_BYTES

    def make(self, task: DropTask, commit: Callable[[FinishedImage], None], report: Report = unreported) -> DropResult:
        """Make the images of one drop, call ``commit`` with each as soon as it is made, and report what is done.

        Raises:
            DatasetError: an image cannot be written.
            BlenderError: Blender cannot be used.
        """
        made, failure = 0, ""
        try:
            _inject_fault(task.drop)
            for image in self._renderer.make(task.drop, task.images, report):
                commit(image)
                made += 1
        except (DatasetError, BlenderError):
            raise
        except DropFailed as error:
            failure = str(error)
        except MemoryError:  # the process ends and returns its memory, and the drop is tried in a new one
            traceback.print_exc()
            os._exit(_EXIT_NO_MEMORY)
        except Exception as error:  # an unexpected error in one drop does not stop the others
            failure = f"{type(error).__name__}: {' '.join(str(error).split())}"
        outgrown = psutil.Process().memory_info().rss > self._memory_limit
        return DropResult(task, made, failure, outgrown=outgrown)


Watch = Callable[[Sequence[Work]], None]
"""Is called with what the workers do, whenever that changes and about once a second."""


def unwatched(_: Sequence[Work]) -> None:
    """Watch nothing."""


def run(
    tasks: Iterable[DropTask], config: WorkerConfig, workers: int, watch: Watch = unwatched
) -> Generator[DropResult, None, None]:
    """Make drops in worker processes, and return the result of each as it ends, in no fixed order.

    A drop that kills its worker is tried once more in another one and then reported, one that hangs is reported at
    once; all others are continued. A worker that dies while it starts is replaced.

    Raises:
        UserError: a file of the dataset cannot be written, or the sources cannot be read any more; nothing further is
            made.
        BlenderError: Blender cannot be used, or workers die again and again while they start.
    """
    pool = _LocalPool(config, workers, watch)
    try:
        yield from pool.work(tasks)
        pool.stop(_END_LIMIT_S)
    finally:
        pool.stop(0.0)  # an image is committed whole or not at all, so workers may die at any moment


@dataclass(eq=False)
class _Worker:
    """A worker process, seen from the process that started it.

    Attributes:
        process, pipe: itself, and the way to it.
        log: file that takes everything it prints, from its first moment.
        since: when it began what it does now.
        ready: whether it has started.
        task: what it does; None while it starts, and between two tasks.
        stage: of this task, or its start.
    """

    process: SpawnProcess
    pipe: Connection
    log: Path
    since: float
    ready: bool = False
    task: DropTask | None = None
    stage: Stage = _START

    @property
    def work(self) -> Work:
        return Work(self.stage, len(self.task.images) if self.task else 0)

    def stop(self, grace_s: float) -> None:
        """End the process: by itself, if it does so within a time."""
        self.pipe.close()
        self.process.join(grace_s)
        self.process.kill()
        self.process.join()

    def last_words(self) -> str:
        """The last lines of its log, as one line; "" if it has none."""
        try:
            text = self.log.read_bytes()[-2000:].decode(errors="replace")
        except OSError:
            return ""
        return " / ".join(" ".join(line.split()) for line in text.splitlines()[-3:] if line.strip())


class _LocalPool:
    """The workers of this machine."""

    def __init__(self, config: WorkerConfig, workers: int, watch: Watch) -> None:
        self._config = config
        self._watch = watch
        self._most = workers
        self._workers: list[_Worker] = []
        self._waiting: deque[DropTask] = deque()
        self._deaths: dict[int, int] = {}
        self._deaths_at_start = 0
        self._numbers = count(1)

    def work(self, tasks: Iterable[DropTask]) -> Iterator[DropResult]:
        """Do all the tasks; errors as in ``run``."""
        source = iter(tasks)
        while True:
            self._waiting.extend(islice(source, max(0, self._most - len(self._waiting))))
            busy = sum(worker.task is not None for worker in self._workers)
            if not self._waiting and not busy:
                return
            while len(self._workers) < min(self._most, busy + len(self._waiting)):
                self._start_worker()
            for worker in [worker for worker in self._workers if worker.ready and worker.task is None]:
                self._hand_out(worker)
            self._watch([each.work for each in self._workers if each.task or not each.ready])
            answered = connection.wait([worker.pipe for worker in self._workers], timeout=_TICK_S)
            for worker in [worker for worker in self._workers if worker.pipe in answered]:
                result = self._receive(worker)
                if result:
                    yield result
            yield from self._give_up_hung()

    def stop(self, grace_s: float) -> None:
        """End all workers."""
        while self._workers:
            self._workers.pop().stop(grace_s)

    def _start_worker(self) -> None:
        log = self._config.root / LOGS_FOLDER / f"worker-{platform.node()}-{os.getpid()}-{next(self._numbers)}.log"
        try:
            log.parent.mkdir(exist_ok=True)
            log.touch()
        except OSError as error:
            raise DatasetError(f"{log}: cannot be written ({error.strerror})") from None
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, self._config, log), daemon=True)
        worker = _Worker(process, ours, log, time.monotonic())
        try:
            with without_interrupts(), without_script(), console_to(log):
                process.start()
                self._workers.append(worker)
        except OSError as error:  # no memory, or no process, is left for it
            ours.close()
            time.sleep(_TICK_S)
            self._died_at_start(f"the error {error.strerror}", worker)
        finally:
            theirs.close()  # so that its end is the pipe's end

    def _hand_out(self, worker: _Worker) -> None:
        """Give a worker the next task, if there is one."""
        if not self._waiting:
            return
        try:
            worker.pipe.send(self._waiting[0])
        except OSError:  # it has died since; that is no fault of this task
            self._remove(worker)
        else:
            worker.task, worker.stage, worker.since = self._waiting.popleft(), Stage(COLLIDERS), time.monotonic()

    def _receive(self, worker: _Worker) -> DropResult | None:
        """Read what a worker sends; the result of its task, if that is known now."""
        try:
            answer = worker.pipe.recv()
        except (EOFError, OSError):
            return self._died(worker)
        if isinstance(answer, Exception):
            raise answer
        self._deaths_at_start = 0
        if isinstance(answer, Stage):
            worker.stage = answer
            return None
        if not isinstance(answer, DropResult):
            worker.ready = True
            return None
        worker.task = None
        if answer.outgrown:
            self._remove(worker, _END_LIMIT_S)
        return answer

    def _died(self, worker: _Worker) -> DropResult | None:
        """Replace a worker; the result of its task, if that task has killed too many."""
        worker.process.join(_TICK_S)
        self._remove(worker)
        task, why = worker.task, f"exit code {worker.process.exitcode}"
        if task is None:
            if not worker.ready:
                self._died_at_start(why, worker)
            return None
        self._deaths[task.drop] = self._deaths.get(task.drop, 0) + 1
        if self._deaths[task.drop] < _DEATHS:
            self._waiting.appendleft(task)
            return None
        return DropResult(task, failure=f"its worker died ({why})", killed=True)

    def _died_at_start(self, why: str, worker: _Worker, weight: int = 1) -> None:
        self._deaths_at_start += weight
        if self._deaths_at_start >= _DEATHS_AT_START:
            words = worker.last_words()
            told = f"; {worker.log} ends: {words}" if words else "; they printed nothing"
            raise BlenderError(f"workers die while starting, the last one with {why}{told}")

    def _give_up_hung(self) -> Iterator[DropResult]:
        now, limit_s = time.monotonic(), self._config.drop_limit_s
        for worker in list(self._workers):
            if worker.task is not None and now - worker.since > limit_s and not worker.pipe.poll():
                self._remove(worker)
                yield DropResult(worker.task, failure=f"took longer than {limit_s:g} s")
            elif not worker.ready and now - worker.since > _START_LIMIT_S:
                self._remove(worker)
                weight = _DEATHS_AT_START // _HANGS_AT_START
                self._died_at_start(f"no answer within {_START_LIMIT_S:g} s", worker, weight)

    def _remove(self, worker: _Worker, grace_s: float = 0.0) -> None:
        self._workers.remove(worker)
        worker.stop(grace_s)


def _serve(pipe: Connection, config: WorkerConfig, log: Path) -> None:
    """In the worker: start, and make drops as long as there is somebody to make them for."""
    with suppress(EOFError, ConnectionError):
        try:
            worker = DropWorker(config, load_sources(config.recipe), devices.take(config.devices), log)
            commit = DatasetStore(config.root, config.recipe).commit
            pipe.send(None)  # started
            while True:
                pipe.send(worker.make(pipe.recv(), commit, pipe.send))
        except (UserError, BlenderError) as error:
            pipe.send(error)


def _inject_fault(drop: int) -> None:
    """Do to this worker what FAULT_VARIABLE asks for at this drop."""
    faults = dict(item.split(":") for item in os.environ.get(FAULT_VARIABLE, "").split(",") if item)
    kind = next((kind for kind, number in faults.items() if int(number) == drop), "")
    if kind == "abort":
        os.abort()
    if kind == "hang":
        time.sleep(1e6)
    if kind == "unsettled":
        raise DropFailed("did not come to rest, as a test asked")
