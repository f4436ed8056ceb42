"""Makes drops on a Ray cluster: workers on many machines, each of which may be lost at any moment.

As on one machine a worker never has more than one drop: so it is always known which one a dead worker was at, and since
when one hangs.
"""

from __future__ import annotations

import logging
import os
import platform
import re
import sys
import time
from collections import Counter, deque
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any
from uuid import uuid4

from synthetless.dataset.layout import LOGS_FOLDER
from synthetless.dataset.store import DatasetStore, FinishedImage, versions
from synthetless.errors import UserError
from synthetless.extras import MissingExtraError
from synthetless.generation.devices import CPU, ask, take_assigned
from synthetless.generation.executors import (
    FAULT_VARIABLE,
    DropResult,
    DropTask,
    DropWorker,
    Watch,
    WorkerConfig,
    unwatched,
)
from synthetless.generation.progress import RENDERING, STARTING, Stage, Work
from synthetless.generation.sources import Sources, load_sources
from synthetless.io.cache import CACHE_VARIABLE
from synthetless.io.files import atomic_write, user_folder
from synthetless.scenes.blender import BlenderError

Node = Mapping[str, Any]
"""A node as Ray describes it: NodeID, Alive, Resources, ..."""

_TICK_S = 1.0
_NODES_EVERY_S = 5.0
"""How often the list of nodes is read: those that join get workers, too."""
_AHEAD = 10_000
"""So many tasks are planned ahead, more than any cluster has workers, but not a million."""
_PATIENCE_S = 60.0
"""After so long without any worker the user is told what is waited for."""
_DEATHS = 2
"""A drop over which so many workers died is given up."""
_DEATHS_AT_START = 5
"""The run ends when so many workers have died while starting, one after the other, and none got through."""
_LOST_NODES = 4
"""A node is lost through no fault of its drops; so many, one after the other, with the same drop are no accident."""
_CONNECT_LIMIT_S = 30.0
_TRIAL = """
import json, logging, sys
import ray
try:
    ray.init(sys.argv[1], log_to_driver=False, logging_level=logging.CRITICAL)
    print(json.dumps({"error": ""}))
except Exception as error:
    print(json.dumps({"error": str(error)}))
"""

_log = logging.getLogger(__name__)


def run(
    tasks: Iterable[DropTask],
    config: WorkerConfig,
    address: str | None = None,
    workers: int | None = None,
    watch: Watch = unwatched,
) -> Generator[DropResult, None, None]:
    """Make drops on a Ray cluster, and return the result of each as it ends, in no fixed order.

    A drop that kills its worker is tried once more in another one and then reported, one that hangs is reported at
    once, those that were under way on a lost node are made again; all others are continued. Workers that share the
    dataset's folder commit what they make; from those that do not the images come back, and are committed here.

    Args:
        tasks: the drops.
        config: what a worker needs to know; it takes ``threads`` cores of a node, or a core and a GPU.
        address: of the cluster, as Ray writes it; None for the one that RAY_ADDRESS names or that runs here.
        workers: how many; None for as many as the cluster has room for, also when nodes join or leave.
        watch: is told how many workers there are; what each of them does only its own machine knows.

    Raises:
        UserError: Ray is not installed, the cluster cannot be reached or has no room for a worker, a node, which is
            named, cannot be used, or a file of the dataset cannot be written; nothing further is made.
        BlenderError: Blender cannot be used on a node.
    """
    sources = load_sources(config.recipe)
    if sources.photos_folder is not None:
        sources = replace(sources, photos_folder=sources.photos_folder.absolute())
    if sources.panoramas_folder is not None:  # they are large: a folder that all nodes can read is needed
        sources = replace(sources, panoramas_folder=sources.panoramas_folder.absolute())
    config = replace(config, root=config.root.absolute())
    token = config.root / LOGS_FOLDER / f"shared-{uuid4().hex}"
    with connected(address or "auto") as ray:
        atomic_write(token, b"")
        try:
            yield from _RayPool(ray, config, sources, token, workers, watch).work(tasks)
        finally:
            with suppress(OSError):
                token.unlink()


@dataclass(frozen=True)
class SharedInputs:
    """What is sent to every worker, once for each node.

    Attributes:
        sources: the models, and the names of the photographs.
        digest: of the scenery where the sources were loaded.
        versions: what must be installed on the node, too.
    """

    sources: Sources
    digest: str
    versions: Mapping[str, str]


@dataclass(frozen=True)
class WorkerInfo:
    """Where a worker is.

    Attributes:
        node_id: Ray's name of the node.
        node: the node's own name.
        process: the worker's number there.
        lacks_photos: whether it could not start, since the photographs are not there.
    """

    node_id: str
    node: str
    process: int
    lacks_photos: bool = False


class RayWorker:
    """A worker on a node: an actor that makes one drop at a time."""

    def __init__(self, config: WorkerConfig, token: Path, environment: Mapping[str, str]) -> None:
        """Find out whether the dataset's folder is here.

        Args:
            config: what to know.
            token: a file in the dataset's folder; who may write it shares the folder.
            environment: variables to set.
        """
        os.environ.update(environment)
        self._config = config
        shares_folder = os.access(token, os.W_OK)
        self._dataset = DatasetStore(config.root, config.recipe) if shares_folder else None
        name = f"worker-{platform.node()}-{os.getpid()}.log"
        # Ray keeps what its workers print, in a file for each of them.
        self._log = config.root / LOGS_FOLDER / name if shares_folder else Path("/dev/stdout")

    def start(self, inputs: SharedInputs, photos: Mapping[str, bytes] | None) -> WorkerInfo:
        """Load the sources and start Blender.

        Args:
            inputs: the sources.
            photos: content of the photographs by name; None as long as no node has been found to lack them.

        Raises:
            UserError: something else is installed here, or there is no such device.
            BlenderError: Blender cannot be used.
        """
        import ray

        info = WorkerInfo(ray.get_runtime_context().get_node_id(), platform.node(), os.getpid())
        try:
            check_versions(inputs.versions)
            sources = _with_photos(inputs, photos)
            if sources is None:
                return replace(info, lacks_photos=True)
            self._worker = DropWorker(self._config, sources, take_assigned(self._config.devices), self._log)
        except BlenderError as error:
            raise BlenderError(f"node {info.node}: {error}") from None
        except UserError as error:
            raise UserError(f"node {info.node}: {error}") from None
        return info

    def make(self, task: DropTask) -> DropResult:
        """Make the images of one drop, and commit them if the dataset's folder is shared; errors as in DropWorker."""
        images: list[FinishedImage] = []
        result = self._worker.make(task, self._dataset.commit if self._dataset else images.append)
        return replace(result, images=tuple(images))

    def answer(self) -> None:
        """Do nothing, when everything that was asked before is done: an answer shows that this worker lives."""


def check_versions(wanted: Mapping[str, str]) -> None:
    """Refuse what would give other pixels, here and there in one dataset.

    Raises:
        UserError: something else than wanted is installed.
    """
    for name, here in versions().items():
        if here != wanted[name]:
            raise UserError(f"has {name} {here}, but {wanted[name]} is needed; install the same on every node")


def _with_photos(inputs: SharedInputs, photos: Mapping[str, bytes] | None) -> Sources | None:
    """The sources with photographs that are on this node: its own, or those sent; None if there are neither."""
    sources = inputs.sources
    if sources.photos_folder is None:
        return sources
    with suppress(OSError):
        if sources.scenery_digest == inputs.digest:
            return sources
    if photos is None:
        return None
    # One for all workers of the node; it is named by its content, so that it may stay.
    folder = user_folder() / f"photos-{inputs.digest[:16]}"
    for name, content in photos.items():
        if not (folder / name).exists():
            atomic_write(folder / name, content)
    return replace(sources, photos_folder=folder)


@dataclass(frozen=True)
class _Call:
    """What a worker does: a task, or (None) its start; since when, and which nodes there were then."""

    worker: Any
    task: DropTask | None
    info: WorkerInfo | None
    since: float
    nodes: frozenset[str]

    @property
    def work(self) -> Work:
        return Work(Stage(RENDERING), len(self.task.images)) if self.task else Work(Stage(STARTING))


class _RayPool:
    """The workers of a cluster; for each of them exactly one call is under way."""

    def __init__(
        self, ray: Any, config: WorkerConfig, sources: Sources, token: Path, workers: int | None, watch: Watch
    ) -> None:
        self._ray = ray
        self._watch = watch
        self._sources = sources
        self._dataset = DatasetStore(config.root, config.recipe)
        self._wanted = workers
        self._nodes, self._nodes_read = living_nodes(ray), time.monotonic()
        self._needs = needs_of(config, self._nodes)
        self._config = config if "num_gpus" in self._needs else replace(config, devices=CPU)
        if not (workers or room_for(self._needs, self._nodes)):
            raise UserError(f"no node of the Ray cluster has room for a worker, which needs {in_words(self._needs)}")
        options = {"max_restarts": 0, "max_task_retries": 0, "scheduling_strategy": "SPREAD", **self._needs}
        self._actor = ray.remote(**options)(RayWorker)
        environment = {name: os.environ[name] for name in (FAULT_VARIABLE, CACHE_VARIABLE) if name in os.environ}
        self._arguments = (ray.put(self._config), token, environment)
        self._inputs = ray.put(SharedInputs(sources, sources.scenery_digest, versions()))
        self._photos: Any = None
        self._waiting: deque[DropTask] = deque()
        self._calls: dict[Any, _Call] = {}
        self._deaths: Counter[tuple[int, bool]] = Counter()
        self._deaths_at_start = 0
        self._last_at_work = time.monotonic()

    def work(self, tasks: Iterable[DropTask]) -> Iterator[DropResult]:
        """Do all the tasks; errors as in ``run``."""
        source = iter(tasks)
        while True:
            self._waiting.extend(islice(source, max(0, _AHEAD - len(self._waiting))))
            if not self._waiting and not any(call.task for call in self._calls.values()):
                return
            self._start_workers()
            self._watch([call.work for call in self._calls.values()])
            for ref in self._ray.wait(list(self._calls), timeout=_TICK_S)[0]:
                result = self._receive(ref, self._calls.pop(ref))
                if result:
                    yield result
            yield from self._give_up_hung()

    def _start_workers(self) -> None:
        """Start as many workers as there are room and work for."""
        now = time.monotonic()
        if now - self._nodes_read > _NODES_EVERY_S:
            self._nodes, self._nodes_read = living_nodes(self._ray), now
        starting = sum(call.task is None for call in self._calls.values())
        limit = self._wanted or max(1, room_for(self._needs, self._nodes))
        for _ in range(min(limit - len(self._calls), len(self._waiting) - starting)):
            self._start(self._actor.remote(*self._arguments))
        if starting < len(self._calls):
            self._last_at_work = now
        elif now - self._last_at_work > _PATIENCE_S:
            self._last_at_work = now
            _log.warning("waiting for the Ray cluster to have %s free", in_words(self._needs))

    def _start(self, worker: Any) -> None:
        self._add_call(worker.start.remote(self._inputs, self._photos), worker, None, None)

    def _hand_out(self, worker: Any, info: WorkerInfo | None) -> None:
        """Give a worker the next task; without one it ends, and leaves its place to others."""
        if self._waiting:
            task = self._waiting.popleft()
            self._add_call(worker.make.remote(task), worker, task, info)
        else:
            self._ray.kill(worker)

    def _add_call(self, ref: Any, worker: Any, task: DropTask | None, info: WorkerInfo | None) -> None:
        self._calls[ref] = _Call(worker, task, info, time.monotonic(), _ids(self._nodes))

    def _receive(self, ref: Any, call: _Call) -> DropResult | None:
        """Continue after a call; the result of its task, if that is known now."""
        errors = self._ray.exceptions
        try:
            answer = self._ray.get(ref)
        except errors.RayTaskError as error:
            raise (error.cause or error) from None
        except errors.ActorUnavailableError:  # out of reach; the next answer tells whether it, or its node, is lost
            self._calls[call.worker.answer.remote()] = call
            return None
        except errors.RayError as error:
            return self._died(call, error)
        if isinstance(answer, WorkerInfo):
            self._started(call.worker, answer)
        elif isinstance(answer, DropResult):
            return self._finished(call, answer)
        elif call.task:  # it could not be reached for a while, and its answer is lost
            self._waiting.appendleft(call.task)
            self._hand_out(call.worker, call.info)
        else:
            self._start(call.worker)
        return None

    def _started(self, worker: Any, info: WorkerInfo) -> None:
        """Give a worker its first task, or send it the photographs that its node lacks."""
        self._deaths_at_start = 0
        if not info.lacks_photos:
            self._hand_out(worker, info)
            return
        folder = self._sources.photos_folder
        if self._photos is None and folder is not None:
            self._photos = self._ray.put({name: (folder / name).read_bytes() for name in self._sources.photos})
        self._start(worker)

    def _finished(self, call: _Call, result: DropResult) -> DropResult:
        if result.outgrown:
            self._ray.kill(call.worker)
        else:
            self._hand_out(call.worker, call.info)
        for image in result.images:  # while the worker is at its next drop
            self._dataset.commit(image)
        return replace(result, images=())

    def _died(self, call: _Call, death: Exception) -> DropResult | None:
        """Have the task of a dead worker done by another one, unless it is the task that kills."""
        self._ray.kill(call.worker)
        self._nodes, self._nodes_read = living_nodes(self._ray), time.monotonic()
        living = _ids(self._nodes)
        task, info = call.task, call.info
        if task is None or info is None:
            self._deaths_at_start += living >= call.nodes
            if self._deaths_at_start >= _DEATHS_AT_START:
                raise BlenderError(
                    f"{self._deaths_at_start} workers of the Ray cluster died while starting ({_exit_of(death)})"
                )
            return None
        node_lost = info.node_id not in living
        self._deaths[task.drop, node_lost] += 1
        if self._deaths[task.drop, node_lost] < (_LOST_NODES if node_lost else _DEATHS):
            self._waiting.appendleft(task)
            return None
        what = f"its node was lost, {_LOST_NODES} times" if node_lost else "its worker died"
        told = f"{what} (node {info.node}, process {info.process}: {_exit_of(death)})"
        return DropResult(task, failure=told, killed=True)

    def _give_up_hung(self) -> Iterator[DropResult]:
        limit_s, now = self._config.drop_limit_s, time.monotonic()
        late = [ref for ref, call in self._calls.items() if call.task and now - call.since > limit_s]
        if not late:
            return
        for ref in self._ray.wait(late, num_returns=len(late), timeout=0)[1]:  # but for answers still to be read
            call = self._calls.pop(ref)
            self._ray.kill(call.worker)
            if call.task:
                yield DropResult(call.task, failure=f"took longer than {limit_s:g} s")


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """The module ``ray``, connected to a cluster for the duration. What runs there for this process ends with it.

    Raises:
        UserError: Ray is not installed, or the cluster cannot be reached.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise MissingExtraError("ray") from None
    # Where nobody answers, Ray tries for two minutes and then ends the process: so another process tries first.
    trial = ask((sys.executable, "-c", _TRIAL, address), _CONNECT_LIMIT_S)
    problem = trial.problem if trial.found is None else trial.found["error"]
    if problem:
        raise UserError(
            f"address {address}: leads to no Ray cluster that can be used ({' '.join(problem.split())}); "
            "give the one that `ray start --head` printed"
        )
    ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    # Ray prints on stdout how workers died; this flag, with which its debugger silences it, is the only way to stop it.
    ray._private.worker._worker_logs_enabled = False
    try:
        yield ray
    finally:
        ray.shutdown()
        ray._private.worker._worker_logs_enabled = True


def living_nodes(ray: Any) -> list[Node]:
    """The nodes of the cluster that are not known to be lost."""
    return [node for node in ray.nodes() if node["Alive"]]


def needs_of(config: WorkerConfig, nodes: Iterable[Node]) -> dict[str, int]:
    """What a worker takes of a node, as options of a Ray actor: a core for each thread, or a core and a GPU."""
    kind = config.devices.kind
    has_gpu = any(node["Resources"].get("GPU", 0) >= 1 for node in nodes)
    if kind == "cpu" or (kind == "auto" and not has_gpu):
        return {"num_cpus": max(1, config.threads)}
    return {"num_cpus": 1, "num_gpus": 1}


def room_for(needs: Mapping[str, int], nodes: Iterable[Node]) -> int:
    """How many workers with these needs the nodes can hold."""
    resources = {"num_cpus": "CPU", "num_gpus": "GPU"}
    return sum(min(int(node["Resources"].get(resources[of], 0) // n) for of, n in needs.items()) for node in nodes)


def in_words(needs: Mapping[str, int]) -> str:
    """What a worker takes of a node, for people."""
    return f"{needs['num_cpus']} CPU" + (" and 1 GPU" if "num_gpus" in needs else "")


def _ids(nodes: Iterable[Node]) -> frozenset[str]:
    return frozenset(node["NodeID"] for node in nodes)


def _exit_of(death: Exception) -> str:
    """What Ray knows of the end of a worker, one line."""
    told = " ".join(str(death).split())
    found = re.search(r"Worker exit type: (\S+) Worker exit detail: (.*?)(?= Some common causes|$)", told)
    return f"{found[1]}: {found[2]}" if found else told
