"""What this machine is like: Blender, its libraries, devices, cores, memory. Nothing here judges."""

from __future__ import annotations

import ctypes
import importlib.metadata
import importlib.util
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

CGROUP = Path("/sys/fs/cgroup")
MEMINFO = Path("/proc/meminfo")
_UNLIMITED_BYTES = 2**60  # version 1 of cgroups writes a number near 2**63 where there is no limit


@dataclass(frozen=True)
class Answer:
    """What a process of its own found out: ``found``, or the ``problem`` it had instead, one line."""

    found: dict[str, Any] | None
    problem: str = ""


def ask(command: Sequence[str], timeout_s: float = 300.0) -> Answer:
    """Run a command that prints a JSON object as its last line; whatever happens to it, this process lives on."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        return Answer(None, f"no answer within {timeout_s:g} s")
    if done.returncode < 0:
        return Answer(None, f"crashed ({signal.Signals(-done.returncode).name})")
    if done.returncode > 0:
        return Answer(None, _last_line(done.stderr) or f"ended with exit code {done.returncode}")
    try:
        found = json.loads(_last_line(done.stdout))
    except ValueError:
        found = None
    return Answer(found) if isinstance(found, dict) else Answer(None, "gave no answer")


def probe(what: str) -> tuple[str, ...]:
    """The command that asks Blender for its ``devices`` or a test ``render``."""
    return (sys.executable, "-m", "synthetless.scenes.probe", what)


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or [""])[-1].strip()


def blender_version() -> str | None:
    """Version of the installed bpy, None without one."""
    try:
        return importlib.metadata.version("bpy")
    except importlib.metadata.PackageNotFoundError:
        return None


def blender_library() -> Path | None:
    """The shared library that is the bpy module, found without loading it; None without one."""
    spec = importlib.util.find_spec("bpy")
    return Path(spec.origin) if spec and spec.origin else None


def unresolved(library: Path) -> tuple[str, ...] | None:
    """Shared libraries that one is linked with, directly or by others, and that the system lacks; None without ldd."""
    try:
        done = subprocess.run(["ldd", library], capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if done.returncode:
        return None
    return tuple(dict.fromkeys(re.findall(r"^\s*(\S+) => not found", done.stdout, re.MULTILINE)))


def unloadable(names: Iterable[str]) -> tuple[str, ...]:
    """Those of the shared libraries that cannot be loaded."""
    return tuple(name for name in names if not _loads(name))


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def core_quota(cgroup: Path = CGROUP) -> float | None:
    """How many cores' worth of time a container is granted, None if as much as there is."""
    quota, period = _numbers(cgroup / "cpu.max", 2)  # "max 100000" without a quota
    if quota is None:
        quota, _ = _numbers(cgroup / "cpu" / "cpu.cfs_quota_us", 1)  # version 1; -1 without a quota
        period, _ = _numbers(cgroup / "cpu" / "cpu.cfs_period_us", 1)
    return quota / period if quota and quota > 0 and period else None


def available_memory_bytes(meminfo: Path = MEMINFO, cgroup: Path = CGROUP) -> int | None:
    """Memory that a new process can have: what is available, at most a container's limit; None if nothing tells."""
    try:
        match = re.search(r"^MemAvailable:\s+(\d+) kB", meminfo.read_text(), re.MULTILINE)
    except OSError:
        match = None
    limits = [_numbers(cgroup / name, 1)[0] for name in ("memory.max", "memory/memory.limit_in_bytes")]
    known = [int(limit) for limit in limits if limit is not None and limit < _UNLIMITED_BYTES]
    if match:
        known.append(1024 * int(match[1]))
    return min(known, default=None)


def _numbers(file: Path, count: int) -> tuple[int | None, int | None]:
    """The first one or two numbers of a file; None for what is missing or no number."""
    try:
        words = file.read_text().split()
    except OSError:
        words = []
    numbers = [int(word) if re.fullmatch(r"-?\d+", word) else None for word in words[:count]]
    first, second = (*numbers, None, None)[:2]
    return first, second


def nearest_existing(folder: Path) -> Path:
    """The folder itself, or the innermost of its parents that exists."""
    absolute = folder.absolute()
    return next(place for place in (absolute, *absolute.parents) if place.is_dir())
