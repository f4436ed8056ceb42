"""The Blender session: one process, one session; started once, left empty between scenes."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from synthetless.extras import MissingExtraError, cv2

Kind = Literal["cpu", "optix", "cuda", "hip", "oneapi", "metal"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""What Cycles can compute on. Of the GPUs, the faster way to use the same one comes first."""


class BlenderError(RuntimeError):
    """Blender cannot be used here; the message says what is missing."""


@dataclass(frozen=True)
class RenderDevice:
    """What Cycles computes on: the processor, or one GPU.

    Attributes:
        kind: one of KINDS.
        number: which of the GPUs of this kind, counted from 0.
    """

    kind: str = "cpu"
    number: int = 0


CPU = RenderDevice()


def start(threads: int = 0, device: RenderDevice = CPU) -> Any:
    """Import bpy, empty its start-up scene and choose what Cycles computes on.

    Args:
        threads: of the renderer, and of what else computes in this process; 0 uses every core.
        device: what to render on.

    Returns:
        The bpy module.

    Raises:
        BlenderError: bpy is not installed, a shared library that it needs is missing, or there is no such device.
    """
    try:
        with console_to(Path(os.devnull)), _one_core() if threads == 1 else contextlib.nullcontext():
            bpy = module()  # it complains of audio devices that a server does not have
    except ModuleNotFoundError:
        raise BlenderError(str(MissingExtraError("bpy"))) from None
    except ImportError as error:
        raise BlenderError(f"Blender cannot start ({error}); run `make system-libraries`") from None
    bpy.ops.wm.read_factory_settings(use_empty=True)
    render = bpy.context.scene.render
    render.threads_mode = "FIXED" if threads else "AUTO"
    if threads:
        render.threads = threads
        _limit_libraries(threads)
    if device.kind != "cpu":
        _compute_on(bpy, device)
    return bpy


@functools.cache  # who asks again, twice a drop, need not put the path in order again
def module() -> Any:
    """Import bpy, also in a process that was spawned from one that has it.

    Blender puts its script folders first in the module search path, at times again and again, and one of them holds an
    inner package that is called bpy, too: a spawned process inherits the path, and would import that.

    Raises:
        ImportError: it is not installed, or a shared library is missing.
    """
    sys.path.sort(key=lambda place: Path(place).match("bpy/*/scripts/*"))  # they come last, the others keep their order
    import bpy

    return bpy


@contextlib.contextmanager
def _one_core() -> Iterator[None]:
    """Let Blender see one core while it counts them.

    ``render.threads`` holds for Cycles' own sampling alone. The denoiser starts a thread for every core of the machine,
    and with a process per core they wait for each other in busy loops.
    """
    if not hasattr(os, "sched_setaffinity"):  # only Linux tells a process its cores
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setaffinity(int(thread.name), cores)


def _limit_libraries(threads: int) -> None:
    """Have NumPy and OpenCV use so many threads; NumPy's wait for one another in busy loops, like the denoiser's."""
    import threadpoolctl

    threadpoolctl.threadpool_limits(threads, user_api="blas")
    cv2.setNumThreads(threads)


def _compute_on(bpy: Any, device: RenderDevice) -> None:
    preferences = bpy.context.preferences.addons["cycles"].preferences
    try:
        preferences.compute_device_type = device.kind.upper()
    except TypeError:  # Blender is built without it
        raise BlenderError(f"this Blender cannot render with {device.kind}; see `synthetless doctor`") from None
    preferences.refresh_devices()
    gpus = [item for item in preferences.devices if item.type == device.kind.upper()]
    if device.number >= len(gpus):
        raise BlenderError(f"there is no {device.kind} device {device.number} here; see `synthetless doctor`")
    for item in preferences.devices:
        item.use = item == gpus[device.number]
    bpy.context.scene.cycles.device = "GPU"


def clear(bpy: Any, keep: set[Any]) -> None:
    """Remove every object, mesh, material, light, world, camera and image but those of ``keep``."""
    data = bpy.data
    blocks = (data.objects, data.meshes, data.materials, data.lights, data.worlds, data.cameras, data.images)
    data.batch_remove([block for kind in blocks for block in kind if block not in keep])


@contextlib.contextmanager
def console_to(log: Path) -> Iterator[None]:
    """Send what Blender's C code prints (file descriptors 1 and 2) to the end of a file for the duration."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [os.dup(1), os.dup(2)]
    target = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.dup2(target, 1)
        os.dup2(target, 2)
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for descriptor, copy in zip((1, 2), saved, strict=True):
            os.dup2(copy, descriptor)
            os.close(copy)
        os.close(target)
