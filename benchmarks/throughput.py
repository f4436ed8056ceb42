"""Where the time of an image goes: ``python -m benchmarks.throughput [--models DIR] [--textures DIR] [--images 12]``.

One worker with one thread makes images of the T-LESS recipe, 720x540 with 10 objects, and commits them to a temporary
folder. Stages are CPU time of the process, from Python's profiler, and within Cycles shared out as its own log says;
the share of the time that is not sampling and denoising is what this project can answer for. Prints a table, writes
benchmarks/results/throughput.json.
"""

from __future__ import annotations

import cProfile
import pstats
import re
import tempfile
import time
from pathlib import Path

from benchmarks import keep, parser, tless_recipe
from synthetless.config import Recipe
from synthetless.dataset.layout import plan_image
from synthetless.dataset.store import DatasetStore
from synthetless.generation import devices
from synthetless.generation.drop import DropRenderer
from synthetless.generation.sources import load_sources

PHASES = {
    "sample": [("sampling.py", "sample_scene")],
    "physics": [("physics.py", "settle"), ("drop.py", "_collider")],
    "build": [("render.py", "scene")],
    "annotate": [("raycast.py", "annotate")],
    "guides": [("guides.py", "make_guides")],
    "cycles": [("render.py", "_rendered")],
    "denoise": [("denoise.py", "denoise")],
    "refine": [("refine.py", "noisy_cells"), ("refine.py", "_sheet")],
    "develop": [("color.py", "exposure_gain"), ("color.py", "picture")],
    "encode": [("store.py", "_encode")],
    "commit": [("store.py", "commit")],
}
"""Functions whose time, with all that they call, makes up a phase."""

_LINE = re.compile(r"^Fra.*Time:(\d+):(\d+\.\d+) .*(Sample 0/|Finished)", re.MULTILINE)


def main() -> None:
    """Measure, print, write."""
    options = parser(__doc__)
    options.add_argument("--images", type=int, default=12)
    options.add_argument("--views", type=int, default=4, help="images of one drop")
    options.add_argument("--quality", default="standard")
    options.add_argument("--device", default="cpu")
    options.add_argument("--set", nargs="*", default=[], help="more settings of the recipe, such as render.samples=12")
    arguments = options.parse_args()
    settings = [f"camera.views_per_drop={arguments.views}", f"render.quality={arguments.quality}", *arguments.set]
    stages = measure(tless_recipe(arguments, *settings), arguments.images, arguments.device)
    total = sum(stages.values()) - stages["start"]
    for name, seconds in stages.items():
        share = "" if name == "start" else f"{seconds / total:7.1%}"
        print(f"{name:10} {seconds / (1 if name == 'start' else arguments.images):8.3f} s {share}")
    outside = 1 - (stages["sampling"] + stages["denoise"]) / total
    rate = 3600 * arguments.images / total
    print(f"outside Cycles' sampling and denoising: {outside:.1%}; {rate:.0f} images an hour and worker")
    result = {**vars(arguments), "stages_s": stages, "outside_share": outside, "images_per_hour": rate}
    keep("throughput", result)


def measure(recipe: Recipe, images: int, wanted: str) -> dict[str, float]:
    """Seconds of each phase for all images together; "start" is once."""
    views = recipe.camera.views_per_drop
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "blender.log"
        sources = load_sources(recipe)
        dataset = DatasetStore.open(Path(folder) / "dataset", recipe, sources.models, sources.scenery_digest)
        began = time.process_time()
        renderer = DropRenderer(recipe, sources, 1, devices.take(devices.choose(wanted)), log)
        stages = {"start": time.process_time() - began}
        # What is made once for each model, whatever the number of images, is made now.
        renderer.session.configure(recipe.render.model_copy(update={"samples": 1, "denoiser": "none"}))
        for drop in range(-(-images // views)):
            list(renderer.make(drop, [plan_image(drop * views, views)]))
        renderer.session.configure(recipe.render)
        log.unlink()

        profile = cProfile.Profile(time.process_time)
        began = time.process_time()
        profile.enable()
        for number in range(0, images, views):
            plans = [plan_image(n, views) for n in range(number, min(number + views, images))]
            for image in renderer.make(number // views, plans):
                dataset.commit(image)
        profile.disable()
        total = time.process_time() - began
        sync, cycles = _logged(log)
        log.unlink()
        stages |= _profiled(profile)
        spent = stages.pop("cycles")
        traced = spent * cycles / (sync + cycles)
        share = 1.0 if recipe.render.denoiser == "guided" else _share_of_sampling(renderer, log, images, views)
        stages |= {"sync": spent - traced, "sampling": share * traced}
        stages["denoise"] += (1 - share) * traced
    return stages | {"other": total - (sum(stages.values()) - stages["start"])}


def _profiled(profile: cProfile.Profile) -> dict[str, float]:
    rows: dict[tuple[str, int, str], tuple[int, int, float, float, object]] = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    times = {(Path(file).name, name): row[3] for (file, _, name), row in rows.items()}
    return {phase: sum(times.get(key, 0.0) for key in keys) for phase, keys in PHASES.items()}


def _share_of_sampling(renderer: DropRenderer, log: Path, images: int, views: int) -> float:
    """Of sampling and denoising together: the first view of each drop, rendered with and without denoiser."""
    seconds = [0.0, 0.0]
    settings = renderer.session.settings
    for drop in range(-(-images // views)):
        spec, settled = renderer.drop(drop)
        with renderer.session.scene(spec, settled) as scene:
            for k, variant in enumerate([settings.model_copy(update={"denoiser": "none"}), settings]):
                renderer.session.configure(variant)
                renderer.render(scene, settled, 0)
                seconds[k] += _logged(log)[1]
                log.unlink()
    return min(seconds[0] / seconds[1], 1.0)


def _logged(log: Path) -> tuple[float, float]:
    """Cycles' own stages in its log, seconds passed: until the first sample, and from there to the denoised image."""
    before = after = 0.0
    for minutes, seconds, what in _LINE.findall(log.read_text(errors="replace")):
        now = 60 * int(minutes) + float(seconds)
        if what == "Finished":
            after += now
        else:
            before += now
    return before, after - before


if __name__ == "__main__":
    main()
