"""Whether this machine can make datasets, and what to do where it cannot.

The lower half finds out what the machine is like; the upper half judges it, by functions of that alone.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import psutil

from synthetless import extras
from synthetless.generation.devices import Answer, ask, probe
from synthetless.io.files import nearest_existing
from synthetless.io.parallel import usable_cores

BLENDER = "4.5"
PACKAGES = {
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libXxf86vm.so.1": "libxxf86vm1",
    "libXfixes.so.3": "libxfixes3",
    "libXi.so.6": "libxi6",
    "libxcb.so.1": "libxcb1",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libSM.so.6": "libsm6",
    "libICE.so.6": "libice6",
    "libuuid.so.1": "libuuid1",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libgomp.so.1": "libgomp1",
    "libstdc++.so.6": "libstdc++6",
    "libgcc_s.so.1": "libgcc-s1",
}
"""The Debian (and Ubuntu) package of each shared library that Blender may want from the system."""
LOADED_LATER = ("libXxf86vm.so.1", "libEGL.so.1")
"""Not linked by Blender 4.5, but by other versions, or looked for when they are needed."""

CGROUP = Path("/sys/fs/cgroup")
_UNLIMITED_BYTES = 2**60  # version 1 of cgroups writes a number near 2**63 where there is no limit

ENOUGH_DISK_GB, LEAST_DISK_GB = 10.0, 0.5
ENOUGH_MEMORY_GB, LEAST_MEMORY_GB = 4.0, 1.0

Status = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Check:
    """One thing that was looked at.

    Attributes:
        name: what.
        status: ok, warn (works, but) or fail.
        value: what was found.
        remedy: what to do about it, "" if there is nothing to do.
    """

    name: str
    status: Status
    value: str
    remedy: str = ""


def examine(folder: Path = Path()) -> tuple[Check, ...]:
    """Look at everything; takes a few seconds, most of it for a test render.

    Args:
        folder: where datasets are to be made; it need not exist.
    """
    place = nearest_existing(folder)
    return (
        check_python(sys.version_info[:3]),
        check_blender(blender_version()),
        check_libraries(missing_libraries(blender_library()), unloadable(LOADED_LATER)),
        check_devices(ask(probe("devices"))),
        check_cores(usable_cores(), core_quota()),
        check_memory(available_memory_bytes()),
        check_disk(shutil.disk_usage(place).free, place),
        check_writable(place),
        check_render(ask(probe("render"))),
    )


def missing_libraries(blender: Path | None) -> tuple[str, ...]:
    """What Blender is linked with and the system lacks; without Blender or ldd, what it is known to need."""
    lacking = unresolved(blender) if blender else None
    if lacking is not None:
        return lacking
    return unloadable(name for name in PACKAGES if name not in LOADED_LATER)


def is_fit(checks: Iterable[Check]) -> bool:
    """Whether nothing fails."""
    return all(check.status != "fail" for check in checks)


def to_json(checks: Iterable[Check]) -> str:
    """One JSON object: ok, and the checks with their name, status, value and remedy."""
    listed = list(checks)
    return json.dumps({"ok": is_fit(listed), "checks": [asdict(check) for check in listed]}, indent=2)


def to_text(checks: Iterable[Check], width: int = 80) -> str:
    """A table for people, no line longer than ``width``; remedies below what they are for."""
    listed = list(checks)
    margin = max(len(check.name) for check in listed) + 8
    lines = []
    for check in listed:
        head = f"{check.status:<4}  {check.name}".ljust(margin)
        lines += _wrapped(check.value, head, margin, width)
        if check.remedy:
            lines += _wrapped(check.remedy, " " * margin + "-> ", margin + 3, width)
    failures = sum(check.status == "fail" for check in listed)
    lines.append("ready to make datasets" if not failures else f"not ready: {failures} of {len(listed)} checks fail")
    return "\n".join(lines)


def _wrapped(text: str, head: str, indent: int, width: int) -> list[str]:
    lines = textwrap.wrap(text, width, initial_indent=head, subsequent_indent=" " * indent, break_on_hyphens=False)
    return lines or [head.rstrip()]


def check_python(version: tuple[int, ...]) -> Check:
    found = ".".join(map(str, version))
    wanted = ".".join(map(str, extras.BLENDER_PYTHON))
    if version[:2] == extras.BLENDER_PYTHON:
        return Check("Python", "ok", found)
    return Check(
        "Python", "fail", found, f"Blender as a module is built for {wanted} only: python{wanted} -m venv .venv"
    )


def check_blender(version: str | None) -> Check:
    install = f"pip install 'bpy=={BLENDER}.*'"
    if version is None:
        return Check("Blender", "fail", "the bpy module is not installed", extras.remedy("blender"))
    if not version.startswith(f"{BLENDER}."):
        return Check("Blender", "warn", f"bpy {version}; datasets are tested with {BLENDER}", install)
    return Check("Blender", "ok", f"bpy {version}")


def check_libraries(missing: Sequence[str], missing_later: Sequence[str] = ()) -> Check:
    """Judge the shared libraries that the system lacks: those needed to start, and those Blender may look for later."""
    if missing:
        return Check("libraries", "fail", f"missing {', '.join(missing)}", _packages([*missing, *missing_later]))
    if missing_later:
        value = f"missing {', '.join(missing_later)}; rendering does without as a rule"
        return Check("libraries", "warn", value, _packages(missing_later))
    return Check("libraries", "ok", "all that Blender needs are there")


def _packages(libraries: Sequence[str]) -> str:
    known = [PACKAGES[name] for name in libraries if name in PACKAGES]
    unknown = [name for name in libraries if name not in PACKAGES]
    install = [f"as root: apt-get install {' '.join(known)}"] if known else []
    return "; ".join(install + [f"apt-file search {name} tells the package" for name in unknown])


def check_devices(answer: Answer) -> Check:
    if answer.found is None:
        return Check("devices", "fail", answer.problem, _by_hand("devices"))
    devices = [f"{device['type']} {device['name']}" for device in answer.found["devices"]]
    if not devices:
        return Check("devices", "fail", "Cycles sees no device to render on", _by_hand("devices"))
    return Check("devices", "ok", ", ".join(devices))


def _by_hand(what: str) -> str:
    return f"mend what fails above; if nothing does, see what this prints: python -m synthetless.scenes.probe {what}"


def check_cores(usable: int, quota: float | None) -> Check:
    """Judge the number of cores: those that this process may run on, and how many of them a container is granted."""
    if quota is not None and quota < usable:
        granted = max(1, round(quota))
        remedy = f"--threads {granted}: threads beyond the quota only take turns"
        return Check("cores", "warn", f"{usable}, of which the container is granted {quota:g}", remedy)
    return Check("cores", "ok", str(usable))


def check_memory(available_bytes: int | None) -> Check:
    if available_bytes is None:
        return Check("memory", "warn", "unknown: the system does not tell")
    gigabytes = available_bytes / 1e9
    value = f"{gigabytes:.1f} GB available"
    remedy = f"{ENOUGH_MEMORY_GB:g} GB are enough; end other programs, or give the container more"
    return Check("memory", *_judged(gigabytes, ENOUGH_MEMORY_GB, LEAST_MEMORY_GB, value, remedy))


def check_disk(free_bytes: int, folder: Path) -> Check:
    gigabytes = free_bytes / 1e9
    value = f"{gigabytes:.1f} GB free in {folder}"
    remedy = "make room, or choose an --out folder on a larger disk"
    return Check("disk", *_judged(gigabytes, ENOUGH_DISK_GB, LEAST_DISK_GB, value, remedy))


def _judged(found: float, enough: float, least: float, value: str, remedy: str) -> tuple[Status, str, str]:
    if found >= enough:
        return "ok", value, ""
    return ("warn" if found >= least else "fail"), value, remedy


def check_writable(folder: Path) -> Check:
    """Try to write a file into an existing folder."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"0")
    except OSError as error:
        remedy = "choose another --out folder, or change the rights of this one"
        return Check("writing", "fail", f"{folder}: {error.strerror}", remedy)
    return Check("writing", "ok", f"{folder} can be written")


def check_render(answer: Answer) -> Check:
    if answer.found is None:
        return Check("render", "fail", answer.problem, _by_hand("render"))
    found = answer.found
    value = f"{found['seconds']:.1f} s for an image of {found['width']}x{found['height']}, {found['samples']} samples"
    if found["mean"] <= 0:
        return Check("render", "fail", f"the image is black; {value}", f"pip install 'bpy=={BLENDER}.*'")
    return Check("render", "ok", value)


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


def available_memory_bytes(cgroup: Path = CGROUP) -> int | None:
    """Memory that a new process can have: what is available, at most a container's limit; None if nothing tells."""
    limits = [_numbers(cgroup / name, 1)[0] for name in ("memory.max", "memory/memory.limit_in_bytes")]
    known = [int(limit) for limit in limits if limit is not None and limit < _UNLIMITED_BYTES]
    with suppress(OSError):  # no /proc here
        known.append(psutil.virtual_memory().available)
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
