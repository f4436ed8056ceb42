"""Which device to render on, among those that Cycles sees."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from synthetless.errors import UserError
from synthetless.generation import machine
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
    """Find the devices of a kind; "auto" takes the best that there is.

    Raises:
        UserError: this machine has none of them; the message says what it has.
        BlenderError: Blender cannot tell.
    """
    if wanted == "cpu":
        return CPU
    answer = machine.ask(machine.probe("devices"))
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
