"""The Blender session: one process, one session; started once, left empty between scenes."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any


class BlenderError(RuntimeError):
    """Blender cannot be used here; the message says what is missing."""


def start(threads: int = 0) -> Any:
    """Import bpy and empty its start-up scene.

    Args:
        threads: of the renderer; 0 uses every core.

    Returns:
        The bpy module.

    Raises:
        BlenderError: bpy is not installed, or a shared library that it needs is missing.
    """
    try:
        with console_to(Path(os.devnull)):  # bpy complains of audio devices that a server does not have
            import bpy
    except ModuleNotFoundError:
        raise BlenderError("Blender is not installed; run: pip install 'synthetless[blender]'") from None
    except ImportError as error:
        raise BlenderError(f"Blender cannot start ({error}); run `make system-libraries`") from None
    bpy.ops.wm.read_factory_settings(use_empty=True)
    render = bpy.context.scene.render
    render.threads_mode = "FIXED" if threads else "AUTO"
    if threads:
        render.threads = threads
    return bpy


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
