"""Which device to render on, among those that Cycles sees."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from synthetless.errors import UserError
from synthetless.io.files import claim
from synthetless.scenes import blender
from synthetless.scenes.blender import KINDS, BlenderError, RenderDevice


@dataclass(frozen=True)
class Devices:
    """What a machine renders on.

    Attributes:
        kind: cpu, or how its GPUs are used: optix, cuda, hip, oneapi or metal.
        count: how many GPUs of this kind there are; 1 for the processor.
    """

    kind: str = "cpu"
    count: int = 1


CPU = Devices()


def choose(wanted: str) -> Devices:
    """Find the devices of a kind; "auto" takes the fastest kind.

    Raises:
        UserError: this machine has none of them; the message says what it has.
        BlenderError: Blender cannot tell.
    """
    if wanted == "cpu":
        return CPU
    answer = ask(probe("devices"))
    if answer.found is None:
        raise BlenderError(f"the devices cannot be listed: {answer.problem}; see `synthetless doctor`")
    return best([device["type"] for device in answer.found["devices"]], wanted)


def take(devices: Devices) -> RenderDevice:
    """The device for this process: the GPUs in turn, so that none waits while another has two workers."""
    if devices.kind == "cpu":
        return blender.CPU
    return RenderDevice(devices.kind, claim(devices.kind) % devices.count)


def take_assigned(devices: Devices) -> RenderDevice:
    """The device for this process of a cluster: the GPU that Ray keeps for it, which sees no other.

    Raises:
        UserError: it sees none.
        BlenderError: as in ``choose``.
    """
    if devices.kind == "cpu":
        return blender.CPU
    kind = choose(devices.kind).kind
    if kind == "cpu":
        raise UserError("offers a GPU to Ray, but Blender sees none; see `synthetless doctor`")
    return RenderDevice(kind)


def best(seen: list[str], wanted: str) -> Devices:
    """Choose among the types of the devices that Cycles sees; errors as in ``choose``."""
    counts = Counter(kind.lower() for kind in seen)
    if wanted == "auto":
        wanted = next((kind for kind in KINDS if kind != "cpu" and counts[kind]), "cpu")
    if wanted != "cpu" and not counts[wanted]:
        found = ", ".join(kind for kind in KINDS if counts[kind]) or "none"
        raise UserError(f"--device {wanted}: Blender sees no such device here, only {found}; see `synthetless doctor`")
    return Devices(wanted, counts[wanted] if wanted != "cpu" else 1)


@dataclass(frozen=True)
class Answer:
    """Result of a command in a process of its own: the object it ``found``, or else its ``problem``, one line."""

    found: dict[str, Any] | None
    problem: str = ""


def ask(command: Sequence[str], timeout_s: float = 300.0) -> Answer:
    """Run a command that prints a JSON object as its last line; its crash does not affect this process."""
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
