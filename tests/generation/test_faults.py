"""Killed workers, no memory, a full disk, a folder that becomes read-only: one line, nothing lost, the same bytes."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import pytest
from trees import data_files

pytestmark = [pytest.mark.blender, pytest.mark.timeout(1200)]

ROOT = Path(__file__).resolve().parents[2]
IMAGES = 8
RECIPE = f"""
images: {IMAGES}
camera: {{width: 64, height: 48, fx: 113, fy: 113, cx: 31.5, cy: 23.5, distance_m: [0.6, 0.9]}}
objects: {{count: [1, 4]}}
render: {{samples: 1}}
"""
KILLS_OF_RUNS, KILLS_AT_START = 2, 10
TOO_LITTLE_BYTES = 64 * 2**20
"""Address space in which Python starts, but not what a worker imports."""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    path.write_text(RECIPE)
    return path


def _start(recipe: Path, out: Path, *options: str, before: tuple[str, ...] = ()) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-m",
        "synthetless",
        "generate",
        str(recipe),
        "--out",
        str(out),
        "--device",
        "cpu",
        "--json-progress",
    ]
    pipe = subprocess.PIPE
    return subprocess.Popen([*before, *command, *options], cwd=ROOT, stdout=pipe, stderr=pipe, text=True)


def _ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code, and the only line on stderr but for those of JSON that tell the progress; a traceback is none."""
    _, errors = process.communicate(timeout=600)
    lines = [line for line in errors.splitlines() if not line.startswith("{") and line.strip()]
    assert len(lines) <= 1, errors
    return process.returncode, lines[0] if lines else ""


def _complete(recipe: Path, out: Path) -> dict[str, bytes]:
    """Give the same command again, undisturbed; every file then."""
    assert _ended(_start(recipe, out, "--workers", "2")) == (0, "")
    return data_files(out)


@pytest.fixture(scope="module")
def undisturbed(recipe: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Every file of the dataset as two workers make it in one go."""
    tree = _complete(recipe, tmp_path_factory.mktemp("undisturbed") / "d")
    assert len([name for name in tree if "/rgb/" in name]) == IMAGES
    return tree


def _workers(pid: int) -> list[psutil.Process]:
    """The living workers of a run, the youngest last."""
    found = []
    with suppress(psutil.NoSuchProcess):
        for process in psutil.Process(pid).children():
            with suppress(psutil.NoSuchProcess):
                if "spawn_main" in " ".join(process.cmdline()) and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
    return sorted(found, key=lambda process: process.create_time())


def test_workers_and_runs_killed_again_and_again(recipe: Path, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    """A random worker every few seconds, and the main process, too; SIGKILL, so that nobody can tidy up."""
    out, chance = tmp_path / "d", random.Random(0)
    for _ in range(KILLS_OF_RUNS):
        process = _start(recipe, out, "--workers", "2")
        end = time.monotonic() + chance.uniform(4, 10)
        while time.monotonic() < end and process.poll() is None:
            time.sleep(chance.uniform(1, 3))
            if workers := _workers(process.pid):
                chance.choice(workers).kill()
        orphans = _workers(process.pid)
        process.kill()
        process.communicate()
        _, alive = psutil.wait_procs(orphans, timeout=60)
        assert not alive, "workers end when nobody is left to work for"
    assert _complete(recipe, out) == undisturbed


def test_workers_killed_while_they_start(recipe: Path, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    """Each of the first ten workers, at any moment of its first second: the run continues without a word."""
    out, chance = tmp_path / "d", random.Random(0)
    process = _start(recipe, out, "--workers", "2")
    lifetimes: dict[int, float] = {}
    while len(lifetimes) <= KILLS_AT_START and process.poll() is None:
        for worker in _workers(process.pid):
            with suppress(psutil.NoSuchProcess):
                lifetime = lifetimes.setdefault(worker.pid, chance.uniform(0, 1))
                if time.time() - worker.create_time() > lifetime and len(lifetimes) <= KILLS_AT_START:
                    worker.kill()
        time.sleep(0.01)
    assert len(lifetimes) > KILLS_AT_START, "the run was over too soon"
    assert _ended(process) == (0, "")
    assert data_files(out) == undisturbed


def _limit_memory(process: subprocess.Popen[str], how_many: int) -> None:
    """Take the memory from so many workers in their first moment."""
    limited = set[int]()
    while process.poll() is None and len(limited) < how_many:
        for worker in _workers(process.pid):
            if worker.pid not in limited:
                limited.add(worker.pid)
                with suppress(psutil.NoSuchProcess):
                    worker.rlimit(psutil.RLIMIT_AS, (TOO_LITTLE_BYTES, TOO_LITTLE_BYTES))
        time.sleep(0.01)


def test_workers_without_memory_end_the_run_with_one_line(
    recipe: Path, undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "d"
    process = _start(recipe, out, "--workers", "2")
    _limit_memory(process, 1000)
    code, line = _ended(process)
    assert code == 2
    assert line.startswith("synthetless: workers die while starting, the last one with ")
    assert "ends: " in line or "printed nothing" in line
    process = _start(recipe, out, "--workers", "2")
    _limit_memory(process, 3)
    assert _ended(process) == (0, ""), "the others get their memory, and the run continues"
    assert data_files(out) == undisturbed


@contextmanager
def _small_disk(options: str) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        mount = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder]
        if subprocess.run(mount, capture_output=True, check=False).returncode:
            pytest.skip("a small file system can be mounted by root alone")
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", "--lazy", folder], check=True)


def test_a_full_disk(recipe: Path, undisturbed: dict[str, bytes]) -> None:
    blocks = {name: 4096 * -(-len(content) // 4096) for name, content in undisturbed.items()}
    lacking = sum(size for name, size in blocks.items() if "/mask" in name or "/rgb/" in name) // 2
    with _small_disk(f"size={sum(blocks.values()) // 2**20 + 8}m") as disk:
        free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
        ballast = disk / "ballast"
        ballast.write_bytes(bytes(free - sum(blocks.values()) + lacking))
        code, line = _ended(_start(recipe, disk / "d", "--workers", "2"))
        assert code == 2, "the disk was to be full before the end"
        assert line.endswith("cannot be written (No space left on device)")
        ballast.unlink()
        assert _complete(recipe, disk / "d") == undisturbed


def test_a_disk_without_inodes(recipe: Path, undisturbed: dict[str, bytes]) -> None:
    with _small_disk(f"size=64m,nr_inodes={len(undisturbed)}") as disk:
        code, line = _ended(_start(recipe, disk / "d", "--workers", "2"))
        assert code == 2, "the disk was to be full before the end"
        assert line.endswith("cannot be written (No space left on device)")
        subprocess.run(["mount", "-o", "remount,nr_inodes=10000", disk], check=True)
        assert _complete(recipe, disk / "d") == undisturbed


def _chmod(root: Path, change: Callable[[int], int]) -> None:
    for folder in [root, *(path for path in root.rglob("*") if path.is_dir())]:
        folder.chmod(change(folder.stat().st_mode))


def test_a_folder_made_read_only_in_the_middle(recipe: Path, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    out = tmp_path / "d"
    as_others: tuple[str, ...] = ()
    if os.getuid() == 0:  # whom permissions do not stop
        as_others = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")
        if subprocess.run([*as_others, "true"], capture_output=True, check=False).returncode:
            pytest.skip("setpriv, which takes root's privileges away, does not work here")
    process = _start(recipe, out, "--workers", "2", before=as_others)
    while not list(out.glob(".records/*/*.json")) and process.poll() is None:
        time.sleep(0.02)
    _chmod(out, lambda mode: mode & ~0o222)
    try:
        code, line = _ended(process)
    finally:
        _chmod(out, lambda mode: mode | 0o200)
    assert code == 2
    assert line.endswith("cannot be written (Permission denied)")
    assert len(list(out.glob(".records/*/*.json"))) >= 1
    assert _complete(recipe, out) == undisturbed
