"""What bop_toolkit (https://github.com/thodan/bop_toolkit) says of the perturbed results; ``golden.json`` keeps it.

    SYNTHETLESS_BOP_TOOLKIT=checkout python tests/learning/golden.py

writes the file anew. The toolkit's functions are called as its scripts eval_calc_errors.py, eval_calc_scores.py and
eval_bop19_pose.py call them; in place of its OpenGL renderer it gets our depth images, in single precision as its own.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
GOLDEN, CHECKOUT = HERE / "golden.json", "SYNTHETLESS_BOP_TOOLKIT"
TAUS = np.arange(0.05, 0.51, 0.05)
DELTA_MM = 15


class Renderer:
    """Ray-cast depth images, asked for as the toolkit asks its renderers."""

    def __init__(self, models: Any, camera: Any) -> None:
        from embreex.rtcore import EmbreeDevice

        from synthetless.annotation.raycast import Surface

        device = EmbreeDevice()
        self.surfaces = {i: Surface(device, model.vertices_mm, model.faces) for i, model in models.items()}
        self.camera = camera

    def render_object(self, obj_id: int, R: Any, t: Any, *_: float) -> dict[str, Any]:
        from synthetless.annotation.instances import image_window
        from synthetless.learning.pose_error import ObjectDepth, RigidPose

        depth = ObjectDepth.cast(self.surfaces[obj_id], RigidPose(R, np.ravel(t)), self.camera)
        return {"depth": depth.over(image_window(self.camera))}


def ask_toolkit(checkout: Path, perturbed: Any) -> dict[str, Any]:
    """Errors of every pair of an estimate and a true pose of its object, and the average recalls."""
    sys.path.insert(0, str(checkout))
    try:
        from bop_toolkit_lib import misc, pose_error
    finally:
        sys.path.remove(str(checkout))
    from perturbed import CAMERA

    from synthetless.dataset import Dataset

    dataset = Dataset.open(perturbed.root)
    renderer = Renderer(perturbed.models, CAMERA)
    infos = dataset.models_info
    syms = {i: misc.get_symmetry_transformations(infos[i], 0.01) for i in infos}
    pairs = []
    for image in dataset:
        depth = image.depth_mm()
        for number, estimate in enumerate(perturbed.estimates):
            if estimate.im_id != image.im_id:
                continue
            for truth in image.instances:
                if truth.obj_id != estimate.obj_id:
                    continue
                R_e, t_e = estimate.R_m2c, estimate.t_m2c.reshape(3, 1)
                R_g, t_g = truth.R_m2c, truth.t_m2c.reshape(3, 1)
                diameter, points = infos[truth.obj_id]["diameter"], perturbed.models[truth.obj_id].vertices_mm
                overlap = misc.overlapping_sphere_projections(0.5 * diameter, t_e.squeeze(), t_g.squeeze())
                vsd, of_paper = (
                    pose_error.vsd(
                        R_e,
                        t_e,
                        R_g,
                        t_g,
                        depth,
                        image.K,
                        DELTA_MM,
                        list(taus),
                        by_diameter,
                        diameter,
                        renderer,
                        truth.obj_id,
                        "step",
                    )
                    for taus, by_diameter in ((TAUS, True), ([20.0], False))
                )
                pairs.append(
                    {
                        "estimate": number,
                        "gt_id": truth.gt_id,
                        "vsd": vsd if overlap else [1.0] * 10,
                        "vsd_20mm": of_paper[0] if overlap else 1.0,
                        "mssd": pose_error.mssd(R_e, t_e, R_g, t_g, points, syms[truth.obj_id]),
                        "near": bool(np.linalg.norm(t_e - t_g) < diameter),
                        "mspd": pose_error.mspd(R_e, t_e, R_g, t_g, image.K, points, syms[truth.obj_id]),
                    }
                )
    return {"pairs": pairs, "recalls": _recalls(checkout, dataset, perturbed.estimates, pairs)}


def _recalls(checkout: Path, dataset: Any, estimates: Any, pairs: list[dict[str, Any]]) -> dict[str, float]:
    """Average recalls as eval_bop19_pose.py has them, and the mean of the objects' recalls by the paper's rule."""
    infos = dataset.models_info

    def errors(kind: str, tau: int = 0) -> dict[int, dict[int, float]]:
        of: dict[int, dict[int, float]] = defaultdict(dict)
        for pair in pairs:
            obj_id = estimates[pair["estimate"]].obj_id
            value = {
                "vsd": lambda p=pair: p["vsd"][tau],
                "vsd_20mm": lambda p=pair: p["vsd_20mm"],
                "mssd": lambda p=pair, o=obj_id: p["mssd"] / infos[o]["diameter"] if p["near"] else np.inf,
                "mspd": lambda p=pair: p["mspd"] * 640 / 320,
            }[kind]()
            of[pair["estimate"]][pair["gt_id"]] = value
        return of

    def mean(kind: str, thresholds: Any, tau: int = 0) -> float:
        of = errors(kind, tau)
        return float(np.mean([_scores(checkout, dataset, estimates, of, th)["recall"] for th in thresholds]))

    asked = sorted({n.obj_id for image in dataset for n in image.instances if n.visibility.visib_fract >= 0.1})
    paper = _scores(checkout, dataset, estimates, errors("vsd_20mm"), 0.3)["obj_recalls"]
    return {
        "vsd": float(np.mean([mean("vsd", TAUS, tau) for tau in range(10)])),
        "mssd": mean("mssd", TAUS),
        "mspd": mean("mspd", np.arange(5, 51, 5)),
        "paper": float(np.mean([paper[obj_id] for obj_id in asked])),
    }


def _scores(checkout: Path, dataset: Any, estimates: Any, errors: dict[int, dict[int, float]], threshold: float) -> Any:
    sys.path.insert(0, str(checkout))
    try:
        from bop_toolkit_lib import pose_matching, score
    finally:
        sys.path.remove(str(checkout))
    gt = {image.im_id: [{"obj_id": n.obj_id} for n in image.instances] for image in dataset}
    info = {image.im_id: [{"visib_fract": n.visibility.visib_fract} for n in image.instances] for image in dataset}
    valid = {im_id: [entry["visib_fract"] >= 0.1 for entry in entries] for im_id, entries in info.items()}
    listed = []
    for im_id, instances in gt.items():
        for obj_id in sorted({instance["obj_id"] for instance in instances}):
            count = sum(ok and n["obj_id"] == obj_id for ok, n in zip(valid[im_id], instances, strict=True))
            own = [i for i, e in enumerate(estimates) if (e.im_id, e.obj_id) == (im_id, obj_id)]
            for i in sorted(own, key=lambda i: estimates[i].score, reverse=True)[:count]:
                listed.append(
                    {
                        "im_id": im_id,
                        "obj_id": obj_id,
                        "est_id": i,
                        "score": estimates[i].score,
                        "errors": {gt_id: [error] for gt_id, error in errors[i].items()},
                        "gt_visib_fracts": {gt_id: info[im_id][gt_id]["visib_fract"] for gt_id in errors[i]},
                    }
                )
    matches = pose_matching.match_poses_scene(1, gt, info, valid, listed, [threshold], -1)
    return score.calc_localization_scores([1], sorted({e.obj_id for e in estimates}), matches, -1, do_print=False)


def main() -> None:
    """Write golden.json anew."""
    sys.path.insert(0, str(HERE))
    from perturbed import build

    with tempfile.TemporaryDirectory() as folder:
        perturbed = build(Path(folder), HERE.parents[1] / "assets" / "parts")
        golden = ask_toolkit(Path(os.environ[CHECKOUT]), perturbed)
    lines = ",\n".join(json.dumps(pair) for pair in golden["pairs"])
    GOLDEN.write_text(f'{{"recalls": {json.dumps(golden["recalls"])},\n"pairs": [\n{lines}\n]}}\n')


if __name__ == "__main__":
    main()
