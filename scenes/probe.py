"""What Blender sees and does on this machine, asked in a process of its own: a Blender that crashes takes that along.

``python -m synthetless.scenes.probe devices`` or ``python -m synthetless.scenes.probe render`` prints one line of JSON.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np
import trimesh

from synthetless.scenes import blender
from synthetless.scenes.render import BlenderSession
from synthetless.scenes.sampling import Catalogue, sample_scene
from synthetless.scenes.settings import ObjectSettings, SceneSettings
from synthetless.scenes.spec import Mesh, Pose


def devices() -> dict[str, Any]:
    """Blender's version, and the type and name of each render device that Cycles sees."""
    bpy = blender.start()
    preferences = bpy.context.preferences.addons["cycles"].preferences
    preferences.refresh_devices()
    found = sorted({(device.type, device.name) for device in preferences.devices})
    return {"version": bpy.app.version_string, "devices": [{"type": kind, "name": name} for kind, name in found]}


def render() -> dict[str, Any]:
    """Render one image as the default recipe would, with Blender's denoiser: size in pixels, samples, seconds, mean."""
    settings = SceneSettings(objects=ObjectSettings(count=(5, 5)))
    camera = settings.camera
    part = trimesh.creation.cylinder(radius=0.02, height=0.05, sections=64)
    mesh = Mesh(np.array(part.vertices, dtype=np.float64), np.array(part.faces, dtype=np.int32))
    spec = sample_scene(settings, Catalogue({1: 0.06}, {}, ()), seed=0, drop=0)
    hovering = [Pose(item.release.rotation_wxyz, (0.06 * (k - 2), 0.0, 0.04)) for k, item in enumerate(spec.objects)]
    without_guides = settings.render.model_copy(update={"denoiser": "fast"})
    session = BlenderSession({("model", 1): mesh}, camera.intrinsics, without_guides, settings.table)
    began = time.perf_counter()
    with session.scene(spec, hovering) as scene:
        image = scene.render(0)
    return {
        "width": camera.width,
        "height": camera.height,
        "samples": settings.render.samples,
        "seconds": time.perf_counter() - began,
        "mean": float(np.nan_to_num(image).mean()),
    }


def main(what: str) -> None:
    """Answer on stdout; exit code 1 and one line on stderr if Blender cannot be used."""
    try:
        answer = {"devices": devices, "render": render}[what]()
    except blender.BlenderError as error:
        sys.exit(str(error))
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
