"""Ray as seen from the process that drives it: reach a cluster, and see what room it has."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from synthetless.errors import UserError
from synthetless.generation.devices import ask
from synthetless.generation.executors import Workplace

Node = Mapping[str, Any]
"""A node as Ray describes it: NodeID, Alive, Resources, ..."""

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


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """The module ``ray``, connected to a cluster for the duration. What runs there for this process ends with it.

    Raises:
        UserError: Ray is not installed, or the cluster cannot be reached.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise UserError("executor ray: Ray is not installed; run: pip install 'synthetless[ray]'") from None
    # Where nobody answers, Ray tries for two minutes and then ends the process: so let another one try first.
    trial = ask((sys.executable, "-c", _TRIAL, address), _CONNECT_LIMIT_S)
    problem = trial.problem if trial.found is None else trial.found["error"]
    if problem:
        raise UserError(
            f"address {address}: leads to no Ray cluster that can be used ({' '.join(problem.split())}); "
            "give the one that `ray start --head` printed"
        )
    ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    # Ray prints on stdout how workers died, and this, by which its debugger silences it, is all there is against it.
    ray._private.worker._worker_logs_enabled = False
    try:
        yield ray
    finally:
        ray.shutdown()
        ray._private.worker._worker_logs_enabled = True


def living_nodes(ray: Any) -> list[Node]:
    """The nodes of the cluster that are not known to be lost."""
    return [node for node in ray.nodes() if node["Alive"]]


def needs_of(place: Workplace, nodes: Iterable[Node]) -> dict[str, int]:
    """What a worker takes of a node, as options of a Ray actor: a core for each thread, or a core and a GPU."""
    kind = place.devices.kind
    has_gpu = any(node["Resources"].get("GPU", 0) >= 1 for node in nodes)
    if kind == "cpu" or (kind == "auto" and not has_gpu):
        return {"num_cpus": max(1, place.threads)}
    return {"num_cpus": 1, "num_gpus": 1}


def room_for(needs: Mapping[str, int], nodes: Iterable[Node]) -> int:
    """How many workers with these needs the nodes can hold."""
    resources = {"num_cpus": "CPU", "num_gpus": "GPU"}
    return sum(min(int(node["Resources"].get(resources[of], 0) // n) for of, n in needs.items()) for node in nodes)


def in_words(needs: Mapping[str, int]) -> str:
    """What a worker takes of a node, for people."""
    return f"{needs['num_cpus']} CPU" + (" and 1 GPU" if "num_gpus" in needs else "")
