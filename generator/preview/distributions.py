"""Histograms of everything a recipe draws, and of what follows from it, each beside what was asked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from synthetless.config import BUILTIN, Recipe
from synthetless.scenes.sampling import lamp_warmth
from synthetless.scenes.settings import ContainerSettings, RoomSettings
from synthetless.scenes.spec import ObjectSpec, RoomSpec, SceneSpec, View
from synthetless.scenes.srgb import srgb_from_linear
from synthetless.scenes.textures import FAMILIES, PhotoTexture

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bounds = tuple[float, float]
Verdict = Literal["as asked", "differs", "too few to judge", "not prescribed"]

SIGNIFICANCE = 1e-4
"""A deviation that the recipe would bring about less often than this is called one: there are some thirty tests."""

FEWEST_VALUES = 20
_FEWEST_EXPECTED = 5.0  # in each category, for the chi-squared approximation to hold
_BINS = 24
_ROUNDING = 1e-9
_SCALES = {"displayed": "as displayed", "linear": "linear"}


@dataclass(frozen=True, eq=False)
class Observations:
    """What is observed in a dataset: N labelled instances in M images.

    Attributes:
        obj_id: (N,) object ids.
        visib_fract: (N,).
        distance_mm: (N,) from the camera to the model's origin.
        objects_per_image: (M,) labelled instances.
        views: the camera of each image that was recorded.
        exposure_gains: of the same images.
        drops: the scenes that those images show, each once.
        luminance: mean displayed luminance, 0..1, of some images, evenly spread.
    """

    obj_id: Integers
    visib_fract: Floats
    distance_mm: Floats
    objects_per_image: Integers
    views: Sequence[View]
    exposure_gains: Floats
    drops: Sequence[SceneSpec]
    luminance: Floats


@dataclass(frozen=True)
class Distribution:
    """How often something takes which value.

    Attributes:
        key: its name in files.
        group: what it belongs to: objects, labels, camera, light, table or image.
        title: what it is, with its unit.
        asked: what the recipe asked for, in words.
        values: how many values there are.
        edges: (B + 1) bounds of the histogram's bins; () if there are categories.
        categories: names of the categories, or ().
        counts: values in each bin or category.
        expected: how many the recipe makes one expect there; None if it asks for nothing.
        bounds: range that all values are to be in, if that is all that is asked.
        p_value: how likely a deviation as large is under the recipe; None where that was not or cannot be judged.
    """

    key: str
    group: str
    title: str
    asked: str
    values: int
    edges: tuple[float, ...]
    categories: tuple[str, ...]
    counts: tuple[int, ...]
    expected: tuple[float, ...] | None
    bounds: Bounds | None
    p_value: float | None

    @property
    def verdict(self) -> Verdict:
        """What to make of it."""
        if self.expected is None and self.bounds is None:
            return "not prescribed"
        if self.p_value is None:
            return "too few to judge"
        return "differs" if self.p_value < SIGNIFICANCE else "as asked"


def labelled_classes(seen: Observations, offered: Sequence[int], recipe: Recipe | None) -> Distribution:
    """Labelled instances per class; ``offered`` are the object ids that were drawn from."""
    found = Counter(seen.obj_id.tolist())
    ids = sorted({*offered, *found})
    drawn = dict.fromkeys(offered, 1.0) if recipe is not None else None
    repeats = recipe.camera.views_per_drop if recipe is not None else 1
    named = {str(obj_id): found[obj_id] for obj_id in ids}
    weights = None if drawn is None else {str(obj_id): drawn.get(obj_id, 0.0) for obj_id in ids}
    asked = "each object equally often"
    return _categories("classes", "objects", "Labelled instances of each class", named, weights, asked, repeats)


def distributions(seen: Observations, recipe: Recipe | None) -> Iterator[Distribution]:
    """All others; those of recorded scenes only where scenes were recorded."""
    yield from _labels(seen)
    if recipe is None or not seen.drops:
        return
    yield from _objects(seen, recipe)
    yield from _camera(seen, recipe)
    yield from _light(seen, recipe)
    yield from _table(seen, recipe)
    yield from _image(seen, recipe)


def _labels(seen: Observations) -> Iterator[Distribution]:
    counts = Counter(seen.objects_per_image.tolist())
    named = {str(n): counts[n] for n in range(max(counts, default=0) + 1)}
    yield _categories("labels_per_image", "labels", "Labelled instances of an image", named, None, "")
    yield _histogram("visib_fract", "labels", "Visible fraction", seen.visib_fract, (0.0, 1.0))
    yield _histogram("object_distance", "labels", "Distance of the objects, m", seen.distance_mm / 1000)


def _objects(seen: Observations, recipe: Recipe) -> Iterator[Distribution]:
    items = [item for spec in seen.drops for item in spec.objects]
    low, high = recipe.objects.count
    dropped = Counter(sum(item.role == "model" for item in spec.objects) for spec in seen.drops)
    sizes = range(min(low, *dropped), max(high, *dropped) + 1)
    named = {str(n): dropped[n] for n in sizes}
    weights = {str(n): float(low <= n <= high) for n in sizes}
    yield _categories("objects_per_drop", "objects", "Objects dropped", named, weights, f"each of {low} to {high}")
    if recipe.release.container != ContainerSettings() or any(spec.container is not None for spec in seen.drops):
        yield _containers(seen, recipe)
    yield _release(items)
    if recipe.objects.tint == 0:
        linear = np.array([item.material.albedo[0] for item in items])
        grey = linear if recipe.objects.grey_scale == "linear" else srgb_from_linear(linear)
        yield _uniform("grey", "objects", f"Grey, {_SCALES[recipe.objects.grey_scale]}", grey, recipe.objects.grey)
    for name, bounds in (("roughness", recipe.objects.roughness), ("specular", recipe.objects.specular)):
        values = np.array([getattr(item.material, name) for item in items])
        yield _uniform(f"object_{name}", "objects", f"{name.capitalize()} of the objects", values, bounds)
    if recipe.objects.metallic != (0, 0):
        metallic = np.array([item.material.metallic for item in items])
        yield _uniform("object_metallic", "objects", "Metallic share of the objects", metallic, recipe.objects.metallic)


def _containers(seen: Observations, recipe: Recipe) -> Distribution:
    asked = recipe.release.container
    none = round(1 - asked.box.share - asked.tray.share, 12)
    weights = {"none": none, "box": asked.box.share, "tray": asked.tray.share}
    found = Counter("none" if spec.container is None else spec.container.kind for spec in seen.drops)
    named = {kind: found[kind] for kind in weights}
    return _categories("containers", "objects", "What drops lie in", named, weights, "the shares of the recipe")


def _release(items: Sequence[ObjectSpec]) -> Distribution:
    """Angles of rotations uniform on SO(3) have the density (1 - cos a) / pi; the test is of the rotations.

    Objects that were set down are left out: they are turned about z alone, or upside down.
    """
    wxyz = np.array([item.release.rotation_wxyz for item in items]).reshape(-1, 4)
    wxyz = wxyz[~((wxyz[:, [1, 2]] == 0).all(axis=1) | (wxyz[:, [0, 3]] == 0).all(axis=1))]
    angle_deg = np.degrees(2 * np.arccos(np.clip(np.abs(wxyz[:, 0]), 0, 1)))
    edges = np.linspace(0, 180, _BINS + 1)
    share = np.diff(np.radians(edges) - np.sin(np.radians(edges))) / np.pi
    asked, p_value = "uniform over all rotations", rotations_p(wxyz)
    return _binned("release", "objects", "Angle of the release rotations, °", angle_deg, edges, share, asked, p_value)


def _camera(seen: Observations, recipe: Recipe) -> Iterator[Distribution]:
    asked = recipe.camera
    for name, title, bounds in (
        ("distance_m", "Distance of the camera, m", asked.distance_m),
        ("elevation_deg", "Elevation of the camera, °", asked.elevation_deg),
        ("azimuth_deg", "Azimuth of the camera, °", asked.azimuth_deg),
        ("roll_deg", "Roll of the camera, °", asked.roll_deg),
    ):
        values = np.array([getattr(view, name) for view in seen.views])
        yield _uniform(f"camera_{name}", "camera", title, values, bounds)


def _light(seen: Observations, recipe: Recipe) -> Iterator[Distribution]:
    asked = recipe.light
    for name, title, bounds in (
        ("azimuth_deg", "Azimuth of the lamp, °", asked.azimuth_deg),
        ("elevation_deg", "Elevation of the lamp, °", asked.elevation_deg),
        ("distance_m", "Distance of the lamp, m", asked.distance_m),
        ("strength", "Strength of the lamp", asked.strength),
        ("radius_m", "Radius of the lamp, m", asked.radius_m),
    ):
        values = np.array([getattr(spec.light, name) for spec in seen.drops])
        yield _uniform(f"light_{name}", "light", title, values, bounds)
    warmth = np.array([lamp_warmth(spec.light) for spec in seen.drops])
    yield _uniform("light_warmth", "light", "Warmth of the lamp", warmth, asked.warmth)
    ambient = np.array([spec.ambient.level for spec in seen.drops])
    yield _uniform("ambient", "light", "Ambient level", ambient, asked.ambient)
    environments = [spec.environment for spec in seen.drops if spec.environment is not None]
    if environments:
        turn_deg = np.array([environment.turn_deg for environment in environments])
        yield _uniform("environment_turn", "light", "Turn of the panorama, °", turn_deg, (0.0, 360.0))
        strength = np.array([environment.strength for environment in environments])
        bounds = asked.environment_strength
        yield _uniform("environment_strength", "light", "Strength of the panorama", strength, bounds)
    if asked.room is not None:
        yield from _room([spec.room for spec in seen.drops if spec.room is not None], asked.room)


def _room(rooms: Sequence[RoomSpec], asked: RoomSettings) -> Iterator[Distribution]:
    for name, title, bounds in (
        ("side_m", "Side of the room, m", asked.side_m),
        ("height_m", "Height of the ceiling, m", asked.height_m),
    ):
        yield _uniform(f"room_{name}", "light", title, np.array([getattr(room, name) for room in rooms]), bounds)
    lamps = [lamp for room in rooms for lamp in room.lamps]
    for name, title, bounds in (
        ("azimuth_deg", "Azimuth of the soft lamps, °", asked.lamp_azimuth_deg),
        ("elevation_deg", "Elevation of the soft lamps, °", asked.lamp_elevation_deg),
        ("distance_m", "Distance of the soft lamps, m", asked.lamp_distance_m),
        ("strength", "Strength of the soft lamps", asked.lamp_strength),
        ("radius_m", "Radius of the soft lamps, m", asked.lamp_radius_m),
    ):
        yield _uniform(f"soft_{name}", "light", title, np.array([getattr(lamp, name) for lamp in lamps]), bounds)
    low, high = asked.lamps
    found = Counter(len(room.lamps) for room in rooms)
    sizes = range(min(low, *found), max(high, *found) + 1)
    named, weights = {str(n): found[n] for n in sizes}, {str(n): float(low <= n <= high) for n in sizes}
    yield _categories("soft_lamps", "light", "Soft lamps of a room", named, weights, f"each of {low} to {high}")


def _table(seen: Observations, recipe: Recipe) -> Iterator[Distribution]:
    planes = [spec.plane for spec in seen.drops]
    textures = (plane.texture for plane in planes)
    found = Counter(texture.file if isinstance(texture, PhotoTexture) else texture.family for texture in textures)
    builtin = recipe.source.textures == BUILTIN
    names = sorted({*found, *(FAMILIES if builtin else ())})
    weights = dict.fromkeys(names, 1.0) if builtin else None
    named = {name: found[name] for name in names}
    yield _categories("texture", "table", "Texture of the table", named, weights, "each family equally often")
    low, high = recipe.table.tile_m
    tile, ends = np.log10([plane.tile_m for plane in planes]), (float(np.log10(low)), float(np.log10(high)))
    asked = f"log-uniform in {low:g} to {high:g} m"
    yield _uniform("tile", "table", "Side of a texture tile, log10 of m", tile, ends, asked)
    turned = np.array([plane.rotation_deg for plane in planes])
    yield _uniform("table_rotation", "table", "Rotation of the texture, °", turned, (0.0, 360.0))
    for name, bounds in (("roughness", recipe.table.roughness), ("specular", recipe.table.specular)):
        values = np.array([getattr(plane, name) for plane in planes])
        yield _uniform(f"table_{name}", "table", f"{name.capitalize()} of the table", values, bounds)


def _image(seen: Observations, recipe: Recipe) -> Iterator[Distribution]:
    low, high = recipe.render.exposure
    if recipe.sensor is not None:  # over-exposure, vignetting and shoulder come after the bounds
        yield _histogram("luminance", "image", "Mean luminance, as displayed", seen.luminance, (0.0, 1.0))
    elif seen.luminance.size:
        kept = bool((seen.luminance > low - 0.02).all() and (seen.luminance < high + 0.02).all())
        edges = np.linspace(0, 1, _BINS + 1)
        asked, p_value = f"within {low:g} to {high:g}", float(kept)
        title = "Mean luminance, as displayed"
        yield _binned("luminance", "image", title, seen.luminance, edges, None, asked, p_value, (low, high))
    yield _histogram("exposure_gain", "image", "Exposure, stops", np.log2(seen.exposure_gains))


def _uniform(key: str, group: str, title: str, values: Floats, bounds: Bounds, asked: str = "") -> Distribution:
    low, high = bounds
    if low == high:
        edges = np.linspace(*_range(np.append(values, low)), _BINS + 1)
        kept = float(bool(np.allclose(values, low)))
        return _binned(key, group, title, values, edges, None, f"always {low:g}", kept, bounds)
    edges = np.linspace(min(low, values.min(initial=low)), max(high, values.max(initial=high)), _BINS + 1)
    share = np.diff(np.clip((edges - low) / (high - low), 0, 1))
    asked = asked or f"uniform in {low:g} to {high:g}"
    return _binned(key, group, title, values, edges, share, asked, uniform_p(values, low, high))


def _histogram(key: str, group: str, title: str, values: Floats, bounds: Bounds | None = None) -> Distribution:
    edges = np.linspace(*(bounds or _range(values)), _BINS + 1)
    return _binned(key, group, title, values, edges, None, "", None)


def _binned(
    key: str,
    group: str,
    title: str,
    values: Floats,
    edges: Floats,
    share: Floats | None,
    asked: str,
    p_value: float | None,
    bounds: Bounds | None = None,
) -> Distribution:
    counts = np.histogram(values, edges)[0]
    expected = None if share is None else tuple((share * values.size).tolist())
    return Distribution(
        key,
        group,
        title,
        asked,
        values.size,
        tuple(edges.tolist()),
        (),
        tuple(counts.tolist()),
        expected,
        bounds,
        p_value,
    )


def _categories(
    key: str,
    group: str,
    title: str,
    counts: dict[str, int],
    weights: dict[str, float] | None,
    asked: str,
    repeats: float = 1.0,
) -> Distribution:
    found, total = tuple(counts.values()), sum(counts.values())
    expected: tuple[float, ...] | None = None
    p_value = None
    if weights is not None:
        whole = sum(weights.values())
        expected = tuple(total * weights[name] / whole for name in counts)
        p_value = categories_p(found, expected, repeats)
    words = asked if weights is not None else ""
    return Distribution(key, group, title, words, total, (), tuple(counts), found, expected, None, p_value)


def _range(values: Floats) -> Bounds:
    """Bounds of a histogram of values about which nothing is known."""
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    return (low, high) if high - low > 1e-9 else (low - 0.5, high + 0.5)


# How likely a deviation as large as the one seen is, had the recipe been kept: None where there are too few values.


def uniform_p(values: Floats, low: float, high: float) -> float | None:
    """Whether values are uniform in [low, high]; 0 if one lies outside.

    Kolmogorov and Smirnov's test, which sees a slope or a shift, and Pearson's over bins, which sees a gap or a peak;
    the smaller p-value counts, twice, since there are two (Bonferroni).
    """
    slack = _ROUNDING * max(1.0, abs(low), abs(high))
    if values.size and (values.min() < low - slack or values.max() > high + slack):
        return 0.0
    if values.size < FEWEST_VALUES or high - low <= slack:
        return None
    bins = min(_BINS, int(values.size // _FEWEST_EXPECTED))
    counts = np.histogram(np.clip(values, low, high), bins, (low, high))[0]
    binned = float(stats.chisquare(counts).pvalue)
    return min(1.0, 2 * min(binned, float(stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue)))


def categories_p(counts: Sequence[int], expected: Sequence[float], repeats: float = 1.0) -> float | None:
    """Whether counts are those of independent draws with the expected frequencies: Pearson's chi-squared test.

    Args:
        counts: of each category.
        expected: of each category, with the same sum; 0 for what must not occur.
        repeats: how often each draw was counted.
    """
    found, wanted = np.array(counts) / repeats, np.array(expected) / repeats
    if (found[wanted == 0] > 0).any():
        return 0.0
    found, wanted = found[wanted > 0], wanted[wanted > 0]
    if len(wanted) < 2 or wanted.min() < _FEWEST_EXPECTED:
        return None
    return float(stats.chi2.sf(((found - wanted) ** 2 / wanted).sum(), len(wanted) - 1))


def rotations_p(wxyz: Floats) -> float | None:
    """Whether rotations, quaternions (N, 4), are uniform on SO(3): Bingham's test of the axes +-q in four dimensions.

    S = p(p + 2)/2 n (tr T^2 - 1/p), T the mean of q q^T, is chi-squared with (p - 1)(p + 2)/2 degrees of freedom
    (Mardia and Jupp, Directional Statistics, 2000, section 10.7.1), here with p = 4.
    """
    if len(wxyz) < FEWEST_VALUES:
        return None
    q = wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    scatter = q.T @ q / len(q)
    return float(stats.chi2.sf(12 * len(q) * (np.trace(scatter @ scatter) - 0.25), 9))
