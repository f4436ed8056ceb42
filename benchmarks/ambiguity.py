"""Time what ``ambiguity`` does for an instance: ``python -m benchmarks.ambiguity [MODELS_DIR]``.

Every model whose models_info.json has a continuous symmetry about z is seen alone at random poses, 720x540, and
compared with itself turned by C_n, as if it had no symmetry. Turns that look alike cost most. Beside it, the same from
all pixels of the window: ``pixels_apart`` as it is defined. CPU time of this process; of each instance the fastest of a
few rounds, since other programs only ever slow one down. Without a folder the models are those that
SYNTHETLESS_TLESS_MODELS names, or the parts that come with the project.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks import default_models, keep
from synthetless.annotation.instances import PosedModel, Window
from synthetless.annotation.raycast import RayCaster, Rays
from synthetless.annotation.scene import scene_caster
from synthetless.io.models import load_models, read_models_info
from synthetless.scenes.spec import Intrinsics
from synthetless.symmetry import CanonicalMap, SymmetryGroup
from synthetless.symmetry.ambiguity import MIN_PIXELS, Ambiguity, Cosets, Resolution, View, What, pixels_apart, see

CAMERA = Intrinsics(width=720, height=540, fx=1075.65091572, fy=1073.90347929, cx=360.0, cy=270.0)
Result = TypeVar("Result")
ORDERS = (2, 6, 12, 24)
DISTANCES_MM = (650.0, 940.0)
N_POSES, N_ROUNDS = 4, 3
COLUMNS = (
    "|H|",
    "instances",
    "pixels",
    "left open",
    "ms mean",
    "ms 95 %",
    "ms most",
    "all pixels: ms",
    "of other verdict",
)


def main() -> None:
    """Measure, print a table, write benchmarks/results/ambiguity.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", type=Path, nargs="?", default=default_models(), help="a BOP models folder")
    parser.add_argument("--what", default="depth", choices=("depth", "normals", "silhouette"))
    arguments = parser.parse_args()
    infos = read_models_info(arguments.models)
    axes = {i: [tuple(each["axis"]) for each in info.get("symmetries_continuous", [])] for i, info in infos.items()}
    models = load_models(arguments.models, tuple(i for i, of in axes.items() if (0, 0, 1) in of))
    caster, what = scene_caster({"model": models}), arguments.what
    rng = np.random.default_rng(0)
    posed = [
        PosedModel(obj_id, Rotation.random(random_state=rng).as_matrix(), np.array([0.0, 0.0, z]))
        for obj_id in models
        for z in rng.uniform(*DISTANCES_MM, N_POSES)
    ]
    rows = [row for order in ORDERS for row in _rows(order, [_measured(caster, body, order, what) for body in posed])]
    print("  ".join(f"{name:>{max(9, len(name))}}" for name in COLUMNS))
    for row in rows:
        cells = zip(COLUMNS, row.values(), strict=True)
        print("  ".join(f"{value:>{max(9, len(name))}}" for name, value in cells))
    keep("ambiguity", {"image_px": [CAMERA.width, CAMERA.height], "what": what, "rows": rows})


def _measured(caster: RayCaster, body: PosedModel, order: int, what: What) -> tuple[float, ...]:
    """Pixels of the object's window, share of the cosets left open, ms, ms from all pixels, verdicts that differ."""
    quasi = SymmetryGroup(f"C{order}")
    cosets, resolution = Cosets.of(quasi, SymmetryGroup.trivial()), Resolution(what)
    R_canonical = CanonicalMap(quasi)(body.R_m2c[None], body.t_m2c[None]).R_m2c[0]
    seen, quick_ms = _timed(lambda: see(caster, CAMERA, body, R_canonical, cosets, resolution=resolution), N_ROUNDS)
    counts, slow_ms = _timed(lambda: _from_all_pixels(caster, seen, body, resolution))
    differing = np.count_nonzero((seen.pixels_apart < MIN_PIXELS) != (counts < MIN_PIXELS))
    pixels = math.prod(caster.pose(body).window(CAMERA).shape)
    return pixels, seen.view_ambiguity, quick_ms, slow_ms, int(differing)


def _from_all_pixels(caster: RayCaster, seen: Ambiguity, body: PosedModel, resolution: Resolution) -> NDArray[np.int64]:
    bodies = [PosedModel(body.obj_id, R, t) for R, t in zip(seen.R_m2c, seen.t_m2c, strict=True)]
    windows = np.array([(w.left, w.top, -w.right, -w.bottom) for w in (caster.pose(b).window(CAMERA) for b in bodies)])
    left, top, right, bottom = np.abs(windows.min(axis=0)).tolist()
    rays = Rays.through(CAMERA, Window(left - 1, top - 1, right + 1, bottom + 1))
    views = [View.of(caster.pose(other), rays, resolution.what) for other in bodies]
    nothing, true = np.full(rays.window.shape, np.inf), views[seen.coset_true]
    return np.array([pixels_apart(true, view, nothing, resolution.what, seen.eps_mm) for view in views])


def _rows(order: int, measured: list[tuple[float, ...]]) -> list[dict[str, float]]:
    """Of one order: the small and the large half of the instances, in pixels."""
    values = np.array(sorted(measured))
    rows = []
    for part in np.array_split(values, 2):
        pixels, ambiguity, quick_ms, slow_ms, differing = part.T
        rows.append(
            {
                "order": order,
                "instances": len(part),
                "pixels_mean": round(float(pixels.mean())),
                "left_open": round(float(ambiguity.mean()), 2),
                "ms_mean": round(float(quick_ms.mean()), 1),
                "ms_95": round(float(np.percentile(quick_ms, 95)), 1),
                "ms_most": round(float(quick_ms.max()), 1),
                "all_pixels_ms_mean": round(float(slow_ms.mean()), 1),
                "other_verdict": int(differing.sum()),
            }
        )
    return rows


def _timed(call: Callable[[], Result], rounds: int = 1) -> tuple[Result, float]:
    times = []
    for _ in range(rounds):
        start = time.process_time()
        result = call()
        times.append(time.process_time() - start)
    return result, 1000 * min(times)


if __name__ == "__main__":
    main()
