"""The workers of a cluster from where they are sent: hired, given one drop at a time, replaced when they are lost.

Since a worker has no more than one drop it is always known which one a dead worker was at, and since when one hangs.
"""

from __future__ import annotations

import logging
import os
import re
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

from synthetless.dataset.layout import LOGS_FOLDER
from synthetless.dataset.store import Dataset
from synthetless.errors import UserError
from synthetless.generation.cluster.connection import Node, connected, in_words, living_nodes, needs_of, room_for
from synthetless.generation.cluster.worker import Delivery, Desk, Supplies, Worker
from synthetless.generation.devices import CPU
from synthetless.generation.executors import FAULT_VARIABLE, Job, Outcome, Workplace
from synthetless.generation.sources import Sources, load_sources
from synthetless.io.files import atomic_write
from synthetless.scenes.blender import BlenderError

_TICK_S = 1.0
_NODES_EVERY_S = 5.0
"""How often it is looked which nodes there are: those that join get workers, too."""
_PATIENCE_S = 60.0
"""After so long without any worker the user is told what is waited for."""
_DEATHS = 2
"""A drop over which so many workers died is given up; so is a cluster where so many die before they begin."""
_LOST_NODES = 4
"""A node is lost through no fault of its drops; one after the other with the same drop is no accident any more."""

_log = logging.getLogger(__name__)


def run(
    jobs: Iterable[Job], place: Workplace, address: str | None = None, workers: int | None = None
) -> Iterator[Outcome]:
    """Make drops on a Ray cluster, and tell of each as it ends, in no fixed order.

    A drop that kills its worker is tried once more in another one and then reported, one that hangs is reported at
    once, those that were under way on a lost node are made again; all others go on. Workers that share the dataset's
    folder commit what they make; from those that do not the images come back, and are committed here.

    Args:
        jobs: the drops.
        place: what a worker needs to know; it takes ``threads`` cores of a node, or a core and a GPU.
        address: of the cluster, as Ray writes it; None for the one that RAY_ADDRESS names or that runs here.
        workers: how many; None for as many as the cluster has room for, also when nodes join or leave.

    Raises:
        UserError: Ray is not installed, the cluster cannot be reached or has no room for a worker, or a node, which is
            named, cannot be used.
        DatasetError: a file of the dataset cannot be written; nothing further is made.
        BlenderError: Blender cannot be used on a node.
    """
    sources = load_sources(place.recipe)
    if sources.photos_folder is not None:
        sources = replace(sources, photos_folder=sources.photos_folder.absolute())
    place = replace(place, root=place.root.absolute())
    token = place.root / LOGS_FOLDER / f"shared-{uuid4().hex}"
    with connected(address or "auto") as ray:
        atomic_write(token, b"")
        try:
            yield from _Crew(ray, place, sources, token, workers).work(jobs)
        finally:
            token.unlink(missing_ok=True)


@dataclass(frozen=True)
class _Call:
    """What a worker is at: a job, or (None) moving in; since when, and which nodes there were then."""

    worker: Any
    job: Job | None
    desk: Desk | None
    since: float
    nodes: frozenset[str]


class _Crew:
    """The workers, for each of whom exactly one call is under way."""

    def __init__(self, ray: Any, place: Workplace, sources: Sources, token: Path, workers: int | None) -> None:
        self._ray = ray
        self._sources = sources
        self._dataset = Dataset(place.root, place.recipe)
        self._wanted = workers
        self._nodes, self._looked = living_nodes(ray), time.monotonic()
        self._needs = needs_of(place, self._nodes)
        self._place = place if "num_gpus" in self._needs else replace(place, devices=CPU)
        if not (workers or room_for(self._needs, self._nodes)):
            raise UserError(f"no node of the Ray cluster has room for a worker, which needs {in_words(self._needs)}")
        options = {"max_restarts": 0, "max_task_retries": 0, "scheduling_strategy": "SPREAD", **self._needs}
        self._actor = ray.remote(**options)(Worker)
        self._introduction = (ray.put(self._place), token, os.environ.get(FAULT_VARIABLE, ""))
        self._supplies = ray.put(Supplies.of(sources))
        self._photos: Any = None
        self._waiting: deque[Job] = deque()
        self._calls: dict[Any, _Call] = {}
        self._deaths: Counter[tuple[int, bool]] = Counter()
        self._stillborn = 0
        self._heard = time.monotonic()

    def work(self, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """Do all the jobs; errors as in ``run``."""
        self._waiting.extend(jobs)
        while self._waiting or any(call.job for call in self._calls.values()):
            self._hire()
            for ref in self._ray.wait(list(self._calls), timeout=_TICK_S)[0]:
                outcome = self._answered(ref, self._calls.pop(ref))
                if outcome:
                    yield outcome
            yield from self._give_up_hung()

    def _hire(self) -> None:
        """Send for as many workers as there are room and work for."""
        now = time.monotonic()
        if now - self._looked > _NODES_EVERY_S:
            self._nodes, self._looked = living_nodes(self._ray), now
        moving_in = sum(call.job is None for call in self._calls.values())
        limit = self._wanted or max(1, room_for(self._needs, self._nodes))
        for _ in range(min(limit - len(self._calls), len(self._waiting) - moving_in)):
            self._move_in(self._actor.remote(*self._introduction))
        if moving_in < len(self._calls):
            self._heard = now
        elif now - self._heard > _PATIENCE_S:
            self._heard = now
            _log.warning("waiting for the Ray cluster to have %s free", in_words(self._needs))

    def _move_in(self, worker: Any) -> None:
        self._note(worker.move_in.remote(self._supplies, self._photos), worker, None, None)

    def _employ(self, worker: Any, desk: Desk | None) -> None:
        """Give a worker the next job; without one it may go, and leave its place to others."""
        if self._waiting:
            job = self._waiting.popleft()
            self._note(worker.make.remote(job), worker, job, desk)
        else:
            self._ray.kill(worker)

    def _note(self, ref: Any, worker: Any, job: Job | None, desk: Desk | None) -> None:
        self._calls[ref] = _Call(worker, job, desk, time.monotonic(), _ids(self._nodes))

    def _answered(self, ref: Any, call: _Call) -> Outcome | None:
        """Go on after a call; what became of its job, if that is known now."""
        errors = self._ray.exceptions
        try:
            answer = self._ray.get(ref)
        except errors.RayTaskError as error:
            raise (error.cause or error) from None
        except errors.ActorUnavailableError:  # out of sight; the next answer tells whether it, or its node, is lost
            self._calls[call.worker.answer.remote()] = call
            return None
        except errors.RayError as error:
            return self._bury(call, error)
        if isinstance(answer, Desk):
            self._seat(call.worker, answer)
        elif isinstance(answer, Delivery) and call.job:
            return self._receive(call, call.job, answer)
        elif call.job:  # it was but out of sight
            self._waiting.appendleft(call.job)
            self._employ(call.worker, call.desk)
        else:
            self._move_in(call.worker)
        return None

    def _seat(self, worker: Any, desk: Desk) -> None:
        """Let a worker begin, or send it the photographs that its node lacks."""
        self._stillborn = 0
        if not desk.lacks_photos:
            self._employ(worker, desk)
            return
        folder = self._sources.photos_folder
        if self._photos is None and folder is not None:
            self._photos = self._ray.put({name: (folder / name).read_bytes() for name in self._sources.photos})
        self._move_in(worker)

    def _receive(self, call: _Call, job: Job, delivery: Delivery) -> Outcome:
        if delivery.swollen:
            self._ray.kill(call.worker)
        else:
            self._employ(call.worker, call.desk)
        for image in delivery.images:  # while the worker is at its next drop
            self._dataset.commit(image)
        return Outcome(job, delivery.made, delivery.failure)

    def _bury(self, call: _Call, death: Exception) -> Outcome | None:
        """Have the job of a dead worker made by another one, unless it is the job that kills."""
        self._ray.kill(call.worker)
        self._nodes, self._looked = living_nodes(self._ray), time.monotonic()
        living = _ids(self._nodes)
        job, desk = call.job, call.desk
        if job is None or desk is None:
            self._stillborn += living >= call.nodes
            if self._stillborn >= _DEATHS:
                raise BlenderError(f"workers of the Ray cluster die before they begin ({_exit_of(death)})")
            return None
        node_lost = desk.node_id not in living
        self._deaths[job.drop, node_lost] += 1
        if self._deaths[job.drop, node_lost] < (_LOST_NODES if node_lost else _DEATHS):
            self._waiting.appendleft(job)
            return None
        what = f"its node was lost, {_LOST_NODES} times" if node_lost else "its worker died"
        told = f"{what} (node {desk.node}, process {desk.process}: {_exit_of(death)})"
        return Outcome(job, failure=told, killed=True)

    def _give_up_hung(self) -> Iterator[Outcome]:
        limit_s, now = self._place.drop_limit_s, time.monotonic()
        late = [ref for ref, call in self._calls.items() if call.job and now - call.since > limit_s]
        if not late:
            return
        for ref in self._ray.wait(late, num_returns=len(late), timeout=0)[1]:  # but for answers still to be read
            call = self._calls.pop(ref)
            self._ray.kill(call.worker)
            if call.job:
                yield Outcome(call.job, failure=f"took longer than {limit_s:g} s")


def _ids(nodes: Iterable[Node]) -> frozenset[str]:
    return frozenset(node["NodeID"] for node in nodes)


def _exit_of(death: Exception) -> str:
    """What Ray knows of the end of a worker, one line."""
    told = " ".join(str(death).split())
    found = re.search(r"Worker exit type: (\S+) Worker exit detail: (.*?)(?= Some common causes|$)", told)
    return f"{found[1]}: {found[2]}" if found else told
