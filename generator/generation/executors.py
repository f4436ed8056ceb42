"""Where drops are made: processes that may die, hang or swell without taking the rest of the dataset with them."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import psutil
from pebble import ProcessExpired, ProcessPool

from synthetless.config import Recipe
from synthetless.dataset.layout import LOGS_FOLDER, ImagePlan
from synthetless.dataset.store import Dataset, DatasetError
from synthetless.generation import devices
from synthetless.generation.devices import CPU, Devices
from synthetless.generation.drop import DropFailed, DropRenderer
from synthetless.generation.sources import load_sources
from synthetless.scenes.blender import BlenderError

FAULT_VARIABLE = "SYNTHETLESS_FAULTS"
"""For tests of what survives: "abort:3,hang:5" lets drop 3 kill its worker and drop 5 never end."""
_RENEW = 75
"""Exit code of a worker that asks to be replaced because its memory has grown."""
GROWTH_LIMIT_BYTES = 1.5e9
"""A worker that has grown by so much is replaced."""


@dataclass(frozen=True)
class Job:
    """The images wanted of one drop."""

    drop: int
    images: tuple[ImagePlan, ...]


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

    Attributes:
        job: which one.
        made: how many images were committed.
        failure: why some are missing, "" if none are.
        killed: whether the worker died over it.
    """

    job: Job
    made: int = 0
    failure: str = ""
    killed: bool = False


@dataclass(frozen=True)
class Workplace:
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


def run(jobs: Iterable[Job], place: Workplace, workers: int) -> Iterator[Outcome]:
    """Make drops in worker processes, and tell of each as it ends, in no fixed order.

    A drop that kills its worker is tried once more in another one and then reported, one that hangs is reported at
    once; all others go on.

    Raises:
        DatasetError: a file of the dataset cannot be written; nothing further is made.
        BlenderError: Blender cannot be used.
    """
    waiting, retried = iter(jobs), set[int]()
    running: dict[Future[Outcome], Job] = {}
    with ProcessPool(max_workers=workers, context=get_context("spawn")) as pool:

        def submit(jobs: Iterable[Job]) -> None:
            for job in jobs:
                running[pool.schedule(_make, args=(place, job), timeout=place.drop_limit_s)] = job

        try:
            submit(islice(waiting, 2 * workers))  # enough that no worker waits, few enough to stop at once
            while running:
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    job = running.pop(future)
                    outcome = _outcome(future, job, place)
                    if outcome is None:
                        submit([job])
                    elif outcome.killed and job.drop not in retried:
                        retried.add(job.drop)
                        submit([job])
                    else:
                        submit(islice(waiting, 1))
                        yield outcome
        except BaseException:
            pool.stop()  # an image is committed whole or not at all, so workers may die at any moment
            raise


def _outcome(future: Future[Outcome], job: Job, place: Workplace) -> Outcome | None:
    """How a job ended; None if its worker only asked to be replaced."""
    try:
        return future.result()
    except (DatasetError, BlenderError):
        raise
    except TimeoutError:
        return Outcome(job, failure=f"took longer than {place.drop_limit_s:g} s")
    except ProcessExpired as death:
        if death.exitcode == _RENEW:
            return None
        return Outcome(job, failure=f"its worker died (exit code {death.exitcode})", killed=True)
    except Exception as error:  # whatever one drop stumbles over, the others can be made
        return Outcome(job, failure=stumbled(error))


def _make(place: Workplace, job: Job) -> Outcome:
    """In the worker: make and commit the images of one drop."""
    inject_fault(job.drop)
    dataset, renderer = Dataset(place.root, place.recipe), _studio(place)
    if psutil.Process().memory_info().rss > _memory_at_start(place) + GROWTH_LIMIT_BYTES:
        os._exit(_RENEW)
    made = 0
    try:
        for image in renderer.make(job.drop, job.images):
            dataset.commit(image)
            made += 1
    except DropFailed as failure:
        return Outcome(job, made, str(failure))
    return Outcome(job, made)


@lru_cache(maxsize=1)
def _studio(place: Workplace) -> DropRenderer:
    """The renderer of this worker, set up at its first drop: from there on Blender talks to the worker's log."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the main process's to answer
    logs = place.root / LOGS_FOLDER
    logs.mkdir(exist_ok=True)
    log = logs / f"worker-{os.getpid()}.log"
    return DropRenderer(place.recipe, load_sources(place.recipe), place.threads, devices.take(place.devices), log)


@lru_cache(maxsize=1)
def _memory_at_start(place: Workplace) -> int:
    rss: int = psutil.Process().memory_info().rss
    return rss


def stumbled(error: Exception) -> str:
    """What a drop failed of that nobody had thought of, one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def inject_fault(drop: int) -> None:
    """Do to this worker what FAULT_VARIABLE asks for at this drop."""
    faults = dict(item.split(":") for item in os.environ.get(FAULT_VARIABLE, "").split(",") if item)
    kind = next((kind for kind, number in faults.items() if int(number) == drop), "")
    if kind == "abort":
        os.abort()
    if kind == "hang":
        time.sleep(1e6)
    if kind == "unsettled":
        raise DropFailed("did not come to rest, as a test asked")
