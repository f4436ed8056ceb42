"""What the depth camera costs, and how far its noise is from its formula: ``python -m benchmarks.depth_sensor``.

CPU seconds of images of 720 x 540 pixels: of the depth camera itself, and of the rays to its projector and the angles;
and the variance of the noise of flat surfaces by the formula's (``scenes/depth_sensor.py``), over the range.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks import keep, parser
from synthetless.annotation.instances import PosedModel
from synthetless.annotation.raycast import Plane, RayCaster
from synthetless.config import models_folder
from synthetless.io.models import load_models
from synthetless.scenes.depth_sensor import Returns, axial_noise_mm, sense, step_mm
from synthetless.scenes.rotations import matrix, random_rotation
from synthetless.scenes.sampling import sample_depth_sensor
from synthetless.scenes.settings import DEPTH_SENSORS, DepthSensorSettings
from synthetless.scenes.spec import DepthSensorSpec, Intrinsics

CAMERA = Intrinsics(720, 540, 1075.65091572, 1073.90347929, 360.0, 270.0)
TABLE = Plane(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 800.0]))


def main() -> None:
    """Measure, print, write benchmarks/results/depth_sensor.json."""
    options = parser(__doc__)
    options.add_argument("--images", type=int, default=10)
    arguments = options.parse_args()
    models = load_models(models_folder(arguments.models))
    caster = RayCaster({("model", i): (model.vertices_mm, model.faces) for i, model in models.items()})
    scenes = [_scene(sorted(models), np.random.default_rng(number)) for number in range(arguments.images)]
    result: dict[str, float] = {}
    without = _cpu_s(partial(caster.annotate, CAMERA, TABLE), scenes)
    seen = [caster.annotate(CAMERA, TABLE, scene, projector_mm=(75, 0, 0)) for scene in scenes]
    result["cpu_s annotation without"] = without
    for name, x in (("angles alone", 0.0), ("angles and projector", 75.0)):
        cast = partial(caster.annotate, CAMERA, TABLE, projector_mm=(x, 0, 0))
        result[f"cpu_s {name}"] = _cpu_s(cast, scenes) - without
    for preset in DEPTH_SENSORS:
        drawn = sample_depth_sensor(DepthSensorSettings.model_validate({"preset": preset}), 0, 0, 0)
        returns = [
            Returns(image.depth_mm, image.illumination.lit, image.illumination.cosine, 0.5 * image.illumination.lit)
            for image in seen
            if image.illumination is not None
        ]
        measure = partial(sense, camera=CAMERA, drawn=drawn)
        result[f"cpu_s {preset}"] = _cpu_s(measure, returns)
        for z_mm in (400.25, 700.25, 1000.25, 2000.25, 4000.25):
            result[f"variance / formula, {preset} at {z_mm:.0f} mm"] = _noise_ratio(z_mm, replace(drawn, speckle=0.0))
    for name, value in result.items():
        print(f"{name:50} {value:.4f}")
    keep("depth_sensor", result)


def _scene(ids: list[int], rng: np.random.Generator) -> list[PosedModel]:
    """Eight parts in the air."""
    places = rng.uniform((-150, -100, 600), (150, 100, 720), (8, 3))
    return [PosedModel(int(rng.choice(ids)), np.array(matrix(random_rotation(rng))), place) for place in places]


def _cpu_s(make: Callable[[Any], object], of: Sequence[object]) -> float:
    """CPU seconds of one call, in the second round: in the first, the parts' trees are built."""
    for each in of:
        make(each)
    began = time.process_time()
    for each in of:
        make(each)
    return (time.process_time() - began) / len(of)


def _noise_ratio(z_mm: float, drawn: DepthSensorSpec) -> float:
    shape = (CAMERA.height, CAMERA.width)
    flat = Returns(np.full(shape, z_mm), np.ones(shape, bool), np.ones(shape, np.float32), np.ones(shape, np.float32))
    sigma = float(axial_noise_mm(np.full(1, z_mm, np.float32), np.zeros(1, np.float32), drawn)[0])
    step = float(step_mm(np.full(1, z_mm), CAMERA, drawn)[0])
    return float(sense(flat, CAMERA, drawn).var() / (sigma**2 + step**2 / 12))


if __name__ == "__main__":
    main()
