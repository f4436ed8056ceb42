"""The cluster executor on a real cluster of two nodes, both on this machine: the same bytes, whatever is killed."""

from __future__ import annotations

import json
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
from trees import data_files

from synthetless.config import Recipe, load_recipe
from synthetless.dataset.layout import LOGS_FOLDER, by_drop
from synthetless.dataset.store import DatasetStore, versions
from synthetless.generation import executors, ray_executor
from synthetless.generation.devices import Devices
from synthetless.generation.executors import FAULT_VARIABLE, DropResult, DropTask, WorkerConfig
from synthetless.generation.ray_executor import check_versions, needs_of, room_for
from synthetless.generation.sources import load_sources

pytest.importorskip("ray", reason="Ray is not installed, extra 'ray'")
pytestmark = [
    pytest.mark.blender,
    pytest.mark.skipif(find_spec("bpy") is None, reason="Blender is not installed, extra 'blender'"),
]

ROOT = Path(__file__).resolve().parents[2]
RECIPE = """
images: 7
camera: {width: 64, height: 48, fx: 113, fy: 113, cx: 31.5, cy: 23.5, distance_m: [0.6, 0.9], views_per_drop: 1}
objects: {count: [1, 2]}
render: {samples: 1}
outputs: [rgb, depth, masks]
"""
SMALL_NODE: dict[str, Any] = {"num_cpus": 1, "object_store_memory": 10**8}
Execute = Callable[[list[DropTask], WorkerConfig], Iterator[DropResult]]


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Recipe:
    path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    path.write_text(RECIPE)
    return load_recipe(path)


@pytest.fixture(scope="module")
def two_nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A cluster of a head and one more node, a core each; nothing of it is left afterwards."""
    from ray.cluster_utils import Cluster

    tmp_path_factory.getbasetemp()  # pytest's own folder must not come to lie in the cluster's
    folder = Path(tempfile.mkdtemp(prefix="ray"))  # short: sockets have short names
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(folder))
        patch.setattr(tempfile, "tempdir", None)
        quick = {"health_check_period_ms": 1000}  # lost nodes are noticed sooner
        nodes = Cluster(True, head_node_args={**SMALL_NODE, "include_dashboard": False, "_system_config": quick})
        try:
            nodes.add_node(**SMALL_NODE)
            yield nodes
        finally:
            nodes.shutdown()
            left = [p for p in psutil.process_iter(["cmdline"]) if str(folder) in " ".join(p.info["cmdline"] or ())]
            psutil.wait_procs(left, timeout=20)
            shutil.rmtree(folder)


def _make(root: Path, recipe: Recipe, execute: Execute, drop_limit_s: float = 300.0) -> list[DropResult]:
    """What generate does, with this executor."""
    sources = load_sources(recipe)
    dataset = DatasetStore.open(root, recipe, sources.models, sources.scenery_digest)
    tasks = [DropTask(drop, tuple(images)) for drop, images in by_drop(dataset.missing(), recipe.camera.views_per_drop)]
    results = list(execute(tasks, WorkerConfig(recipe, root, threads=1, drop_limit_s=drop_limit_s)))
    dataset.finish()
    return sorted(results, key=lambda result: result.task.drop)


def _images(tree: dict[str, bytes]) -> dict[str, bytes]:
    return {name: content for name, content in tree.items() if "/rgb/" in name}


@pytest.fixture(scope="module")
def reference(recipe: Recipe, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Every file of the dataset as one local worker makes it."""
    root = tmp_path_factory.mktemp("reference") / "d"
    _make(root, recipe, partial(executors.run, workers=1))
    return data_files(root)


def _at_work() -> list[psutil.Process]:
    """The processes of the cluster that are at a drop."""
    return [p for p in psutil.process_iter(["cmdline"]) if "ray::RayWorker.make" in " ".join(p.info["cmdline"] or ())]


def _generate(out: Path, address: str) -> subprocess.CompletedProcess[str]:
    recipe = out.parent / "tiny.yaml"
    recipe.write_text(RECIPE)
    command = [sys.executable, "-m", "synthetless", "generate", recipe, "--out", out, "--json"]
    return subprocess.run(
        [*command, "--executor", "ray", "--address", address], cwd=ROOT, capture_output=True, text=True, check=False
    )


def test_the_cluster_does_not_change_a_byte(two_nodes: Any, reference: dict[str, bytes], tmp_path: Path) -> None:
    done = _generate(tmp_path / "d", two_nodes.address)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["made"] == len(_images(reference))
    assert len(done.stderr.splitlines()) < 20, "a bar, and nothing of Ray"
    made = data_files(tmp_path / "d")
    assert {name: made[name] for name in reference} == reference
    assert made.keys() - reference.keys() == {"preview.jpg"}
    logs = list((tmp_path / "d" / LOGS_FOLDER).iterdir())
    assert len(logs) == 2, "a worker on each node, and no token any more"


def test_an_address_that_is_none_is_a_wrong_request(tmp_path: Path) -> None:
    done = _generate(tmp_path / "d", "nonsense")
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert last.startswith("synthetless: address nonsense: leads to no Ray cluster that can be used (")
    assert "Traceback" not in done.stderr


def test_images_and_sources_travel_where_no_folder_is_shared(
    two_nodes: Any, recipe: Recipe, builtin_models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything lies in a folder that each process knows by the same name, but finds something else under it."""
    own = Path("/proc/self/cwd")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(builtin_models, tmp_path / "models")
    (tmp_path / "photos" / "walls").mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "photos" / "walls" / "wall.png"), noise)
    (tmp_path / "photos" / "floor.png").write_bytes((tmp_path / "photos" / "walls" / "wall.png").read_bytes())
    source = recipe.source.model_copy(update={"models": str(own / "models"), "textures": str(own / "photos")})
    travelling = recipe.model_copy(update={"images": 3, "source": source})

    _make(tmp_path / "local", travelling, partial(executors.run, workers=1))
    results = _make(own / "d", travelling, partial(ray_executor.run, address=two_nodes.address))
    assert [(result.made, result.failure) for result in results] == [(1, "")] * 3
    assert data_files(tmp_path / "d") == data_files(tmp_path / "local")
    assert list((tmp_path / "d" / LOGS_FOLDER).iterdir()) == [], "no worker has been here"


def test_a_lost_node_and_a_killed_worker_do_not_change_a_byte(
    two_nodes: Any,
    recipe: Recipe,
    reference: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """The node is the only one with what workers need, so that the work is on it; another such node joins later."""
    special = {**SMALL_NODE, "num_gpus": 1}
    nodes = [two_nodes.add_node(**special)]
    deaths = []
    died = ray_executor._RayPool._died

    def note(self: Any, call: Any, death: Exception) -> DropResult | None:
        deaths.append(" ".join(str(death).split()))
        return died(self, call, death)

    def run(tasks: list[DropTask], config: WorkerConfig) -> Iterator[DropResult]:
        for count, result in enumerate(ray_executor.run(tasks, config, two_nodes.address)):
            yield result
            if count == 0:
                with _interrupted() as worker:
                    two_nodes.remove_node(nodes.pop(), allow_graceful=False)
                    worker.kill()
                nodes.append(two_nodes.add_node(**special))
            if count == 1:
                with _interrupted() as worker:
                    worker.kill()

    monkeypatch.setattr(ray_executor._RayPool, "_died", note)
    monkeypatch.setattr(ray_executor, "needs_of", lambda config, nodes: {"num_cpus": 1, "num_gpus": 1})
    results = _make(tmp_path / "d", recipe, run)
    two_nodes.remove_node(nodes.pop())
    assert [(result.made, result.failure) for result in results] == [(1, "")] * recipe.images
    assert data_files(tmp_path / "d") == reference
    of_node = ["node has died" in death for death in deaths]
    assert of_node[0], "and of workers that were sent there before it was known"
    assert not of_node[-1]
    assert capfd.readouterr().out == "", "Ray keeps its comments to itself"


@contextmanager
def _interrupted() -> Iterator[psutil.Process]:
    """A process that stands still in the middle of a drop."""
    _wait_until(lambda: bool(_at_work()))
    worker = _at_work()[0]
    worker.suspend()
    assert worker in _at_work()
    yield worker


def test_drops_that_kill_hang_or_never_settle_do_not_stop_the_others(
    two_nodes: Any, recipe: Recipe, reference: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FAULT_VARIABLE, "abort:1,hang:2,unsettled:4")
    results = _make(tmp_path / "d", recipe, partial(ray_executor.run, address=two_nodes.address), drop_limit_s=15)
    failed = {result.task.drop: result for result in results if result.failure}
    assert failed.keys() == {1, 2, 4}
    assert re.fullmatch(r"its worker died \(node \S+, process \d+: SYSTEM_ERROR: .+\)", failed[1].failure)
    assert failed[1].killed
    assert failed[2].failure == "took longer than 15 s"
    assert failed[4].failure == "did not come to rest, as a test asked"
    images = _images(data_files(tmp_path / "d"))
    assert len(images) == recipe.images - 3
    assert images == {name: reference[name] for name in images}


def test_a_run_that_is_left_stops_its_workers_and_can_be_gone_on_with(
    two_nodes: Any, recipe: Recipe, reference: dict[str, bytes], tmp_path: Path
) -> None:
    def first(tasks: list[DropTask], config: WorkerConfig) -> Iterator[DropResult]:
        results = ray_executor.run(tasks, config, two_nodes.address)
        yield next(results)
        results.close()  # type: ignore[attr-defined]

    _make(tmp_path / "d", recipe, first)
    _wait_until(lambda: not _at_work())
    _make(tmp_path / "d", recipe, partial(executors.run, workers=1))
    assert data_files(tmp_path / "d") == reference


def _wait_until(fulfilled: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not fulfilled():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture
def nowhere(recipe: Recipe, tmp_path: Path) -> WorkerConfig:
    return WorkerConfig(recipe, tmp_path, threads=1, drop_limit_s=60.0)


def test_an_address_where_nobody_answers_is_refused_soon(
    nowhere: WorkerConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_executor, "_CONNECT_LIMIT_S", 6.0)
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{deaf.getsockname()[1]}"
        with pytest.raises(ValueError, match=rf"^address {address}: leads to no Ray cluster .* within 6 s.*`ray start"):
            list(ray_executor.run([], nowhere, address))


def test_without_ray_it_is_told_how_to_install_it(nowhere: WorkerConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"^Ray is not installed; run: pip install .*\[ray\]'$"):
        list(ray_executor.run([], nowhere))


def test_nodes_hold_as_many_workers_as_their_cores_or_gpus_allow(nowhere: WorkerConfig) -> None:
    nodes = [{"Resources": {"CPU": 8.0, "GPU": 2.0}}, {"Resources": {"CPU": 5.0}}, {"Resources": {"memory": 1e9}}]
    assert room_for(needs_of(nowhere, nodes), nodes) == 13
    assert room_for(needs_of(replace(nowhere, threads=2), nodes), nodes) == 4 + 2
    for kind, wanted in (("auto", 2), ("optix", 2), ("cpu", 13)):
        assert room_for(needs_of(replace(nowhere, devices=Devices(kind)), nodes), nodes) == wanted
    assert room_for(needs_of(replace(nowhere, devices=Devices("auto")), nodes[1:]), nodes[1:]) == 5


def test_a_gpu_that_no_node_offers_is_refused(two_nodes: Any, nowhere: WorkerConfig) -> None:
    with pytest.raises(ValueError, match=r"^no node of the Ray cluster has room for .* needs 1 CPU and 1 GPU$"):
        list(ray_executor.run([], replace(nowhere, devices=Devices("optix")), two_nodes.address))


def test_a_node_with_another_blender_is_refused() -> None:
    check_versions(versions())
    with pytest.raises(ValueError, match=r"^has bpy \S+, but 4\.2\.0 is needed; install the same on every node$"):
        check_versions({**versions(), "bpy": "4.2.0"})
