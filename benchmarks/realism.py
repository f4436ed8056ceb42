"""How objects lie in a recipe's drops, beside real T-LESS test images, and how bright the pictures of datasets are.

    python -m benchmarks.realism configs/tless_bin.yaml --models DIR
    python -m benchmarks.realism --pictures DATASET ...

Of recipes, physics and ray casting alone, nothing is rendered: 200 drops of 10 objects take about 4 minutes of one
core. With ``--set key=value`` a recipe can be tuned until its row is that of the real images. Prints a table and writes
benchmarks/results/realism.json. Needs Blender.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import ROOT, keep, parser
from synthetless.annotation.raycast import RayCaster
from synthetless.annotation.scene import annotate_scene, scene_caster
from synthetless.config import Recipe, load_recipe
from synthetless.dataset.reader import Dataset
from synthetless.generation.sources import Sources, cached_collider, load_sources
from synthetless.io.cache import Cache
from synthetless.io.color import mean_luminance
from synthetless.io.parallel import each
from synthetless.scenes.collider import Collider
from synthetless.scenes.physics import NotSettled, PhysicsSettings, settle
from synthetless.scenes.rotations import matrix
from synthetless.scenes.sampling import sample_scene
from synthetless.scenes.spec import Mesh, Role

Floats = NDArray[np.float64]
Key = tuple[Role, int]

REAL_SHARES = (0.05, 0.1, 0.25, 0.5)
ELEVATIONS_DEG = (12.0, 74.0)
"""Between which the real camera stood; recipes are looked at from there."""


@dataclass(frozen=True)
class Real:
    """Visible fractions in real T-LESS test images: their mean, and the values below which some shares of them lie."""

    mean: float
    values: tuple[float, ...]
    shares: tuple[float, ...] = REAL_SHARES

    def quantiles(self, share: Floats) -> Floats:
        """Values by share: linear between those that are known, and above the last as 1 - c (1 - share)^k.

        The k is the one that gives the mean.
        """
        values, shares = np.array((0.0, *self.values)), np.array((0.0, *self.shares))
        below = float(((values[1:] + values[:-1]) / 2 * np.diff(shares)).sum())
        rest = 1 - (self.mean - below) / (1 - shares[-1])  # mean of 1 - value above the last known share
        exponent = max((1 - values[-1]) / rest - 1, 0.0) if rest > 0 else 1e9
        above = 1 - (1 - values[-1]) * np.clip((1 - share) / (1 - shares[-1]), 0, 1) ** exponent
        return np.where(share < shares[-1], np.interp(share, shares, values), above)

    def distance(self, visible: Floats) -> float:
        """Kolmogorov and Smirnov's distance of visible fractions from the real ones."""
        grid = np.linspace(0.001, 0.999, 999)
        real, seen = self.quantiles(grid), np.sort(visible)
        largest = 0.0
        for value in np.arange(0.01, 1.0, 0.01):
            largest = max(
                largest, abs(float(np.mean(real <= value)) - np.searchsorted(seen, value, "right") / len(seen))
            )
        return largest


REAL = {
    "all 20 scenes": Real(0.835, (0.1, 0.25, 0.41, 0.5, 0.74, 0.9, 0.99), (0.023, 0.05, 0.1, 0.128, 0.25, 0.366, 0.5)),
    "the heavy scenes 9, 13, 18, 20": Real(0.725, (0.07, 0.19, 0.51, 0.87)),
}


OF_REAL_IMAGES = {
    "objects in an image, median (range)": "6 (1-18)",
    "visible fraction, mean": ".835 / .725",
    "  below which 5, 10, 25, 50 % lie": ".25 .41 .74 .99 / .07 .19 .51 .87",
    "  share below .1, .5, .9": ".023 .128 .366",
    "raised more than 10 mm above the ground": ".22",
    "z up, z down, within 3 degrees": ".46 .11",
    "cut by the border by more than 10 %": "0",
}
"""The same of 1000 real T-LESS test images, whose poses were ray-cast, by the rows of the table."""


CLIPPED, TOLERATED = 254, 0.01
"""A pixel with a channel at this level or above is clipped; so many of an image's pixels may be."""


@dataclass(frozen=True)
class Lying:
    """How an object lies in a drop: its lowest point above what the drop lies on, and where its z axis points."""

    height_m: float
    up: float


@dataclass(frozen=True)
class Drop:
    """What is counted of a drop.

    Attributes:
        container: what it lies in.
        throws: until one came to rest.
        refused: why the others did not.
        gap_m, penetration_m: the largest of its objects.
        lying: of each labelled object.
        visible: fractions of the labelled objects in all views.
        cut: share of each that lies outside the image.
        in_image: labelled objects of each view.
    """

    container: str
    throws: int
    refused: tuple[str, ...]
    gap_m: float
    penetration_m: float
    lying: tuple[Lying, ...]
    visible: tuple[float, ...]
    cut: tuple[float, ...]
    in_image: tuple[int, ...]


@dataclass(frozen=True)
class Task:
    """A drop to be made, by the recipe as JSON."""

    recipe: str
    drop: int


def main() -> None:
    """Measure, print, write."""
    options = parser(__doc__)
    options.add_argument("recipe", type=Path, nargs="*", help="configs/tless_bop.yaml, if nothing else is given")
    options.add_argument("--pictures", type=Path, nargs="+", default=[], metavar="DATASET", help="with rgb images")
    options.add_argument("--drops", type=int, default=200)
    options.add_argument("--first", type=int, default=0, help="number of the first drop")
    options.add_argument("--views", type=int, default=4, help="of each drop")
    options.add_argument("--workers", type=int, default=1)
    options.add_argument("--set", action="append", default=[], help="key=value, as of generate")
    arguments = options.parse_args()
    sources = [f"source.{name}={json.dumps(getattr(arguments, name))}" for name in ("models", "textures")]
    views = [f"camera.elevation_deg={list(ELEVATIONS_DEG)}", f"camera.views_per_drop={arguments.views}"]
    rows = {}
    for path in arguments.pictures:
        rows[str(path)] = brightness(Dataset.open(path))
        print(f"\n{path}")
        for name, value in rows[str(path)].items():
            print(f"  {name:48} {value}")
    recipes = arguments.recipe or ([] if arguments.pictures else [ROOT / "configs" / "tless_bin.yaml"])
    for path in recipes:
        recipe = load_recipe(path, [*sources, *views, *arguments.set])
        tasks = [Task(recipe.model_dump_json(), arguments.first + number) for number in range(arguments.drops)]
        drops = list(each(make, tasks, arguments.workers, path.name, "drop"))
        rows[path.name] = table(drops)
        print(f"\n{path.name}, {arguments.drops} drops, {arguments.views} views each")
        print(f"  {'':48} {'drops':28} real: all 20 scenes / the heavy ones")
        for name, value in rows[path.name].items():
            print(f"  {name:48} {value:28} {OF_REAL_IMAGES.get(name, '')}".rstrip())
    keep("realism", rows)


def brightness(dataset: Dataset) -> dict[str, str]:
    """What is counted of a dataset's pictures, by name."""
    pictures = [image.rgb() for image in dataset]
    clipped = np.array([float((rgb >= CLIPPED).any(axis=2).mean()) for rgb in pictures])
    luminance = np.array([mean_luminance(rgb) for rgb in pictures])
    objects = [
        255 * mean_luminance(rgb[mask][:, None])
        for rgb, image in zip(pictures, dataset, strict=True)
        for instance in image.instances
        if (mask := instance.mask_visib()).any()
    ]
    return {
        "images": f"{len(pictures)}",
        "of which more than 1 % of the pixels clip": f"{np.mean(clipped > TOLERATED):.3f}",
        "clipped share of an image, median, q95, largest": " ".join(
            f"{value:.4f}" for value in np.quantile(clipped, (0.5, 0.95, 1.0))
        ),
        "mean luminance of an image, displayed, range": f"{luminance.min():.2f} {luminance.max():.2f}",
        "luminance of an object, 8 bits, mean, spread": f"{np.mean(objects):.0f} {np.std(objects):.0f}",
    }


def make(task: Task) -> Drop:
    """Let the objects of a drop fall until they rest, and look at them."""
    recipe, sources, colliders, caster = _inputs(task.recipe)
    refused: list[str] = []
    while True:
        spec = sample_scene(recipe, sources.catalogue, recipe.seed, task.drop, attempt=len(refused))
        bodies = [colliders[item.role, item.obj_id] for item in spec.objects]
        physics = PhysicsSettings(crowding=recipe.release.crowding)
        try:
            settled = settle(bodies, [item.release for item in spec.objects], physics, spec.container)
            break
        except NotSettled as failure:
            refused.append(" ".join(word for word in str(failure).split() if not word[0].isdigit()))
    ground = 0.0 if spec.container is None else spec.container.wall_m
    lying = []
    for item, body, pose in zip(spec.objects, bodies, settled.poses, strict=True):
        if item.role == "model":
            R = matrix(pose.rotation_wxyz)
            lowest = float((body.surface.vertices_m @ R[2]).min()) + pose.position_m[2]
            lying.append(Lying(lowest - ground, float(R[2, 2])))
    images = [annotate_scene(caster, recipe, spec, settled.poses, view).image for view in range(len(spec.views))]
    seen = [instance for image in images for instance in image.instances]
    return Drop(
        container="none" if spec.container is None else spec.container.kind,
        throws=len(refused) + 1,
        refused=tuple(refused),
        gap_m=max(settled.gaps_m),
        penetration_m=max(settled.penetrations_m),
        lying=tuple(lying),
        visible=tuple(instance.visib_fract for instance in seen),
        cut=tuple(1 - np.count_nonzero(instance.mask) / instance.px_count_all for instance in seen),
        in_image=tuple(len(image.instances) for image in images),
    )


@lru_cache(maxsize=1)
def _inputs(recipe_json: str) -> tuple[Recipe, Sources, dict[Key, Collider], RayCaster]:
    """What all drops of a recipe share; once in a process."""
    recipe = Recipe.model_validate_json(recipe_json)
    sources, cache = load_sources(recipe), Cache.default()
    by_role = sources.by_role
    colliders = {
        (role, obj_id): cached_collider(Mesh(model.vertices_mm / 1000, model.faces), cache)
        for role, models in by_role.items()
        for obj_id, model in models.items()
    }
    return recipe, sources, colliders, scene_caster(by_role)


def table(drops: Sequence[Drop]) -> dict[str, str]:
    """The columns of a recipe, by name."""
    visible = np.array([value for drop in drops for value in drop.visible])
    lying = [item for drop in drops for item in drop.lying]
    up, height = np.array([item.up for item in lying]), np.array([item.height_m for item in lying])
    steep = np.cos(np.radians(3))
    counts = np.array([count for drop in drops for count in drop.in_image])
    cut = np.array([value for drop in drops for value in drop.cut])
    kinds = Counter(drop.container for drop in drops)
    rows = {
        "objects in an image, median (range)": f"{np.median(counts):g} ({counts.min()}-{counts.max()})",
        "visible fraction, mean": f"{visible.mean():.3f}",
        "  below which 5, 10, 25, 50 % lie": " ".join(f"{value:.2f}" for value in np.quantile(visible, REAL_SHARES)),
        "  share below .1, .5, .9": " ".join(f"{np.mean(visible < value):.3f}" for value in (0.1, 0.5, 0.9)),
        **{f"  distance from {name}": f"{real.distance(visible):.3f}" for name, real in REAL.items()},
        "raised more than 10 mm above the ground": f"{np.mean(height > 0.01):.3f}",
        "z up, z down, within 3 degrees": f"{np.mean(up > steep):.3f} {np.mean(up < -steep):.3f}",
        "cut by the border by more than 10 %": f"{np.mean(cut > 0.1):.3f}",
        "lying in none, box, tray": " ".join(f"{kinds[kind] / len(drops):.3f}" for kind in ("none", "box", "tray")),
    }
    return rows | dict(_physics(drops))


def _physics(drops: Sequence[Drop]) -> Iterator[tuple[str, str]]:
    for kind in ("none", "box", "tray"):
        of_kind = [drop for drop in drops if drop.container == kind]
        if of_kind:
            first = np.mean([drop.throws == 1 for drop in of_kind])
            gap, depth = (1000 * max(getattr(drop, name) for drop in of_kind) for name in ("gap_m", "penetration_m"))
            yield f"{kind}: first throws that rest; gap, penetration", f"{first:.3f}; {gap:.2f} {depth:.2f} mm"
    reasons = Counter(" ".join(reason.split()[1:4]) for drop in drops for reason in drop.refused)
    yield "throws refused", ", ".join(f"{count} {reason}" for reason, count in reasons.most_common(4)) or "none"


if __name__ == "__main__":
    main()
