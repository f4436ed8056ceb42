"""However a dataset comes about, it has the same bytes: workers, parts, a cluster, killed processes, a full disk.

SYNTHETLESS_IDENTITY_IMAGES sets how many images are made each time; 60 is a good number for an evening.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from trees import SHARED_LOCK, data_files

pytestmark = [pytest.mark.blender, pytest.mark.timeout(3000)]

ROOT = Path(__file__).resolve().parents[2]
IMAGES = int(os.environ.get("SYNTHETLESS_IDENTITY_IMAGES", "8"))
RECIPE = f"""
images: {IMAGES}
camera: {{width: 64, height: 48, fx: 113, fy: 113, cx: 31.5, cy: 23.5, distance_m: [0.6, 0.9]}}
objects: {{count: [1, 4]}}
render: {{samples: 1}}
"""
DEATHS = 5


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    path.write_text(RECIPE)
    return path


def _start(recipe: Path, out: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "synthetless", "generate", str(recipe), "--out", str(out), "--device", "cpu"]
    pipe = subprocess.PIPE
    return subprocess.Popen([*command, *options], cwd=ROOT, stdout=pipe, stderr=pipe, text=True)


def _run(recipe: Path, out: Path, *options: str) -> int:
    process = _start(recipe, out, *options)
    _, errors = process.communicate(timeout=2500)
    assert process.returncode in {0, 1, 2}, errors
    return process.returncode


@pytest.fixture(scope="module")
def undisturbed(recipe: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Every file of the dataset as one worker makes it in one go."""
    out = tmp_path_factory.mktemp("undisturbed") / "d"
    assert _run(recipe, out, "--workers", "1") == 0
    tree = data_files(out)
    assert len([name for name in tree if "/rgb/" in name]) == IMAGES
    return tree


def test_two_workers(recipe: Path, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    assert _run(recipe, tmp_path / "d", "--workers", "2") == 0
    assert data_files(tmp_path / "d") == undisturbed


def test_three_parts(recipe: Path, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    """At the same time, as on three machines."""
    out = tmp_path / "d"
    processes = [_start(recipe, out, "--workers", "1", "--part", f"{k}/3") for k in (1, 2, 3)]
    assert [process.communicate(timeout=2500) and process.returncode for process in processes] == [0, 0, 0]
    assert data_files(out, {SHARED_LOCK}) == undisturbed


def test_killed_again_and_again(recipe: Path, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    """A random worker every few seconds, and the main process five times; SIGKILL, so that nobody can tidy up."""
    out, chance = tmp_path / "d", random.Random(0)
    for _ in range(DEATHS):
        process = _start(recipe, out, "--workers", "2")
        end = time.monotonic() + chance.uniform(4, 10)
        while time.monotonic() < end and process.poll() is None:
            time.sleep(chance.uniform(1, 3))
            workers = [p for p in _children(process.pid) if "spawn_main" in " ".join(p.cmdline())]
            if workers:
                chance.choice(workers).kill()
        orphans = _children(process.pid)
        process.kill()
        process.communicate()
        _, alive = psutil.wait_procs(orphans, timeout=60)
        assert not alive, "workers end when nobody is left to work for"
    codes = [_run(recipe, out, "--workers", "2")]
    assert codes == [0]
    assert data_files(out) == undisturbed


def _children(pid: int) -> list[psutil.Process]:
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


@contextmanager
def _small_disk(megabytes: int) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        mount = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", folder]
        if subprocess.run(mount, capture_output=True, check=False).returncode:
            pytest.skip("a small file system can be mounted by root alone")
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", "--lazy", folder], check=True)


def test_a_full_disk_that_is_freed(recipe: Path, undisturbed: dict[str, bytes]) -> None:
    blocks = {name: 4096 * -(-len(content) // 4096) for name, content in undisturbed.items()}
    lacking = sum(size for name, size in blocks.items() if "/mask" in name or "/rgb/" in name) // 2
    with _small_disk(sum(blocks.values()) // 2**20 + 8) as disk:
        free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
        ballast = disk / "ballast"
        ballast.write_bytes(bytes(free - sum(blocks.values()) + lacking))
        code = _run(recipe, disk / "d", "--workers", "2")
        assert code == 2, "the disk was to be full before the end"
        ballast.unlink()
        assert _run(recipe, disk / "d", "--workers", "2") == 0
        assert data_files(disk / "d") == undisturbed


def test_a_cluster(recipe: Path, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    if "SYNTHETLESS_IDENTITY_IMAGES" not in os.environ:
        pytest.skip("test_cluster.py compares fewer images sooner")
    pytest.importorskip("ray", reason="Ray is not installed, extra 'ray'")
    from ray.cluster_utils import Cluster

    cluster = Cluster(True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        cluster.add_node(num_cpus=1)
        assert _run(recipe, tmp_path / "d", "--executor", "ray", "--address", cluster.address) == 0
    finally:
        cluster.shutdown()
    assert data_files(tmp_path / "d") == undisturbed
