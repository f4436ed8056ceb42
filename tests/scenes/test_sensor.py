"""The sensor stage against closed forms: noise, edges, shift, vignetting, shoulder; and what it must leave alone."""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import curve_fit
from scipy.stats import norm

from synthetless.config import Recipe, RecipeError, dump_recipe, load_recipe
from synthetless.io.color import picture, tonemap
from synthetless.scenes.sampling import draw_sensor, sample_sensor
from synthetless.scenes.sensor import blurred, capture, demosaicked, expose, gaussian_kernel
from synthetless.scenes.settings import SENSORS, SensorSettings
from synthetless.scenes.spec import SensorSpec

Floats = NDArray[np.float64]

IDEAL = SensorSpec(
    blur_px=0.0,
    vignetting=0.0,
    exposure_ev=0.0,
    shoulder=0.0,
    photons=1e9,
    read_noise=0.0,
    red_gain=1.0,
    blue_gain=1.0,
    chroma_px=0.0,
    sharpen=0.0,
    sharpen_px=1.0,
    jpeg_quality=None,
    noise_seed=0,
)
"""Does nothing but count so many photons that their noise is below 0.02 of an 8-bit level."""


def linear_of(levels: NDArray[np.uint8]) -> Floats:
    displayed = levels / 255
    return np.where(displayed <= 0.04045, displayed / 12.92, ((displayed + 0.055) / 1.055) ** 2.4)


def slope(x: float) -> float:
    """8-bit levels per linear light, of the sRGB curve."""
    return 255 * (12.92 if x <= 0.0031308 else 1.055 / 2.4 * x ** (1 / 2.4 - 1))


def flat(x: float, side: int = 512) -> NDArray[np.float32]:
    return np.full((side, side, 3), x, dtype=np.float32)


def noisy_image(side: int = 64) -> NDArray[np.float32]:
    return np.random.default_rng(5).random((side, side + 6, 3), dtype=np.float32)


# --- noise ---


@pytest.mark.parametrize(
    ("x", "photons", "read_noise"),
    [
        (0.02, 50000, 0.0005),
        (0.05, 20000, 0.001),
        (0.1, 3000, 0.003),
        (0.3, 400, 0.001),
        (0.3, 3000, 0.003),
        (0.6, 400, 0.01),
        (0.85, 2000, 0.01),
    ],
)
def test_the_noise_has_the_variance_of_its_formula(x: float, photons: float, read_noise: float) -> None:
    """At the pixels that see green, where demosaicing adds nothing; 700,000 of them, so that chance is 0.2 %.

    The formula takes the tone curve as straight over the noise; the cases are those where it is, to 1 %.
    """
    drawn = replace(IDEAL, photons=photons, read_noise=read_noise)
    levels = np.concatenate([expose(flat(x, 836), replace(drawn, noise_seed=n)) for n in range(2)])[..., 1]
    green = np.concatenate([levels[::2, 1::2].ravel(), levels[1::2, ::2].ravel()]).astype(np.float64)
    expected = slope(x) ** 2 * (x / photons + read_noise**2) + 1 / 12
    assert green.var() == pytest.approx(expected, rel=0.02)
    assert linear_of(levels).mean() == pytest.approx(x, rel=0.005)


def test_the_noise_of_neighbours_is_independent() -> None:
    green = expose(flat(0.3), replace(IDEAL, photons=1000))[..., 1].astype(np.float64)
    a, b = green[::2, 1::2][:, :-1], green[::2, 1::2][:, 1:]
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.02


def test_without_noise_a_flat_image_stays_flat() -> None:
    assert np.ptp(expose(flat(0.4, 32), IDEAL)) == 0


# --- edges ---


def edge_of(kernel_px: float) -> tuple[Floats, Floats]:
    """Height of a blurred edge, sharp in the scene, over the distance from it, in steps of 1/64 px."""
    i = np.arange(-40, 41)
    places = np.arange(64) / 64
    rows = np.clip(i[None, :] + 0.5 - places[:, None], 0, 1).astype(np.float32)  # the mean over each pixel
    heights = [blurred(np.repeat(row[None], 3, axis=0), kernel_px)[1] for row in rows]
    x = (i[:, None] - places[None, :]).ravel()
    order = np.argsort(x)
    return x[order], np.array(heights).T.ravel()[order].astype(np.float64)


def rise(x: Floats, height: Floats) -> float:
    low, high = (float(np.interp(level, height, x)) for level in (0.1, 0.9))
    return high - low


def formula(blur_px: float) -> float:
    return float(2.563 * np.sqrt(blur_px**2 + 1 / 12))


@pytest.mark.parametrize("blur_px", [0.2, 0.35, 0.5, 0.6, 0.7, 0.9, 1.0, 1.5, 2.0, 3.0, 6.0])
def test_an_edge_has_the_variance_of_its_formula(blur_px: float) -> None:
    x, height = edge_of(blur_px)
    spread, middle = np.diff(height), (x[1:] + x[:-1]) / 2
    mean = (spread * middle).sum()
    width = 2.563 * np.sqrt((spread * (middle - mean) ** 2).sum())
    assert width == pytest.approx(formula(blur_px), rel=0.002)
    assert abs(mean) < 0.01


@pytest.mark.parametrize(("blur_px", "tolerance"), [(0.5, 0.03), (1.0, 0.02), (1.5, 0.02), (2.0, 0.02), (4.0, 0.02)])
def test_an_edge_rises_over_the_width_of_its_formula(blur_px: float, tolerance: float) -> None:
    assert rise(*edge_of(blur_px)) == pytest.approx(formula(blur_px), rel=tolerance)


def fitted_edge(drawn: SensorSpec, channel: int) -> tuple[float, float]:
    """Place and standard deviation of an edge in the finished image, over all its places on the mosaic."""
    i, places = np.arange(-20, 21), np.arange(32) / 16
    x, heights = [], []
    for place in places:
        row = 0.1 + 0.7 * np.clip(i + 0.5 - place, 0, 1)
        image = np.broadcast_to(row[None, :, None], (12, 41, 3)).astype(np.float32)
        heights.append((linear_of(expose(image, drawn))[4:8, :, channel].mean(axis=0) - 0.1) / 0.7)
        x.append(i - place)

    def edge(x: Floats, mean: float, sigma: float) -> Floats:
        return np.asarray(norm.cdf((x - mean) / sigma))

    (mean, sigma), _ = curve_fit(edge, np.concatenate(x), np.concatenate(heights), p0=(0.0, 1.0))
    return float(mean), float(sigma)


@pytest.mark.parametrize("channel", [0, 1, 2])
@pytest.mark.parametrize("blur_px", [1.0, 1.5, 3.0])
def test_the_whole_camera_keeps_the_edge_s_place_and_width(blur_px: float, channel: int) -> None:
    """Mosaic, demosaicing and 8 bits included. The mosaic widens narrower edges than these, as in any camera."""
    mean, sigma = fitted_edge(replace(IDEAL, blur_px=blur_px), channel)
    assert abs(mean) < 0.01
    assert 2.563 * sigma == pytest.approx(formula(blur_px), rel=0.02)


@pytest.mark.parametrize(
    "change", [{}, {"blur_px": 0.5}, {"chroma_px": 2.0}, {"sharpen": 2.5}, {"shoulder": 0.5, "blur_px": 2.0}]
)
def test_nothing_is_shifted(change: dict[str, Any]) -> None:
    """A bright line, at all its places on the mosaic, has its centre where it was, in every channel."""
    i, off = np.arange(-20, 21), []
    for place in np.arange(32) / 16:
        row = 0.1 + 0.5 * np.exp(-((i - place) ** 2) / 4)
        image = np.broadcast_to(row[None, :, None], (12, 41, 3)).astype(np.float32)
        height = expose(image, replace(IDEAL, **change))[4:8].mean(axis=0) - expose(flat(0.1, 16), IDEAL)[8, 8]
        near = np.abs(i - place) <= 8
        off.append((height[near] * (i[near, None] - place)).sum(axis=0) / height[near].sum(axis=0))
    assert (np.abs(np.mean(off, axis=0)) < 0.01).all()


@given(st.floats(0, 10))
def test_a_kernel_has_the_moments_of_the_gaussian(sigma_px: float) -> None:
    kernel = gaussian_kernel(sigma_px).astype(np.float64)
    k = np.arange(len(kernel)) - len(kernel) // 2
    assert (kernel == kernel[::-1]).all()
    assert kernel.sum() == pytest.approx(1, abs=1e-6)
    assert (kernel * k**2).sum() == pytest.approx(sigma_px**2, rel=1e-3, abs=1e-6)
    assert (kernel * k**4).sum() == pytest.approx(3 * sigma_px**4, rel=1e-2, abs=1e-5)
    assert kernel.min() > -0.0036


def test_a_point_spread_is_round() -> None:
    point = np.zeros((21, 21), dtype=np.float32)
    point[10, 10] = 1
    spread = blurred(point, 1.2)
    np.testing.assert_allclose(spread, spread.T, atol=1e-7)
    np.testing.assert_allclose(spread[10, 10:15], spread[10, 10:5:-1], atol=1e-7)


def test_demosaicing_keeps_planes_of_grey() -> None:
    row, column = np.mgrid[:20, :30].astype(np.float32)
    plane = 0.1 + 0.01 * row + 0.02 * column
    inside = demosaicked(plane)[2:-2, 2:-2]
    np.testing.assert_allclose(inside, np.repeat(plane[2:-2, 2:-2, None], 3, axis=2), atol=1e-6)


def test_demosaicing_keeps_a_flat_colour() -> None:
    colour = np.array([0.7, 0.2, 0.4], dtype=np.float32)
    levels = expose(np.broadcast_to(colour, (16, 16, 3)).astype(np.float32), IDEAL)
    assert np.abs(levels.astype(int) - tonemap(colour[None, None], 1.0).astype(int)).max() <= 1


# --- light ---


def test_the_corners_lose_what_vignetting_says() -> None:
    light = linear_of(expose(flat(0.5, 201), replace(IDEAL, vignetting=0.3)))[..., 1]
    assert light[100, 100] == pytest.approx(0.5, rel=0.01)
    for corner in (light[0, 0], light[0, -1], light[-1, 0], light[-1, -1]):
        assert corner == pytest.approx(0.7 * 0.5, rel=0.01)
    assert light[100, 0] == pytest.approx((1 - 0.15) * 0.5, rel=0.01)


def test_a_crop_is_vignetted_as_in_the_whole_image() -> None:
    drawn = replace(IDEAL, vignetting=0.4)
    whole = expose(flat(0.5, 100), drawn)
    crop = expose(flat(0.5, 100)[10:60, 40:90], drawn, corner_px=(40, 10), frame_px=(100, 100))
    assert np.abs(whole[10:60, 40:90].astype(int) - crop.astype(int)).max() <= 1


@pytest.mark.parametrize("stops", [-1.0, 0.5])
def test_exposure_is_in_stops(stops: float) -> None:
    seen = linear_of(expose(flat(0.2, 16), replace(IDEAL, exposure_ev=stops), gain=1.5))
    assert seen.mean() == pytest.approx(0.2 * 1.5 * 2**stops, rel=0.01)


def test_the_shoulder_bends_highlights_alone_and_never_clips_them() -> None:
    drawn = replace(IDEAL, shoulder=0.3)
    light = np.linspace(0, 3, 400, dtype=np.float32)
    image = np.repeat(np.repeat(light[None, :, None], 8, axis=0), 3, axis=2)
    seen = linear_of(expose(image, drawn))[4, :, 1]
    below = light < 0.68
    np.testing.assert_allclose(seen[below], light[below], atol=0.006)
    assert (np.diff(seen) > -0.02).all()
    expected = 0.7 + 0.3 * (1 - np.exp(-(light - 0.7) / 0.3))
    np.testing.assert_allclose(seen[~below], expected[~below], atol=0.012)


def test_the_white_balance_is_that_of_its_gains() -> None:
    seen = linear_of(expose(flat(0.3, 16), replace(IDEAL, red_gain=0.8, blue_gain=1.2)))
    np.testing.assert_allclose(seen[8, 8], [0.24, 0.3, 0.36], rtol=0.01)


def test_chroma_smoothing_removes_colour_and_keeps_luminance() -> None:
    drawn = replace(IDEAL, photons=500.0)
    rough, smooth = (linear_of(expose(flat(0.4), replace(drawn, chroma_px=px))) for px in (0.0, 2.0))
    luminance = np.array([0.2126, 0.7152, 0.0722])
    assert (smooth @ luminance).std() == pytest.approx((rough @ luminance).std(), rel=0.05)
    coloured = np.sqrt(0.4 / 500 * (1 + 1 / 2) / (np.pi * 2.0**2))  # a quarter of the pixels see red, half see green
    assert (smooth[..., 0] - smooth[..., 1]).std() == pytest.approx(coloured, rel=0.1)
    assert (rough[..., 0] - rough[..., 1]).std() > 2 * coloured


def test_sharpening_gives_edges_halos() -> None:
    image = np.repeat(np.repeat(np.where(np.arange(40) < 20, 0.1, 0.4)[None, :, None], 20, axis=0), 3, axis=2)
    plain, sharp = (expose(image.astype(np.float32), replace(IDEAL, sharpen=a))[10, :, 1] for a in (0.0, 2.0))
    assert int(sharp.max()) > int(plain.max()) + 5
    assert int(sharp.min()) < int(plain.min()) - 5
    assert (sharp[:10] == plain[:10]).all()
    assert (sharp[-10:] == plain[-10:]).all()


def test_jpeg_changes_pixels_a_little() -> None:
    image = blurred(noisy_image(), 2.0)
    plain, low, high = (expose(image, replace(IDEAL, jpeg_quality=q)).astype(int) for q in (None, 70, 98))
    assert 0 < np.abs(high - plain).mean() < np.abs(low - plain).mean() < 10


# --- the same, and other, bytes ---


@pytest.mark.parametrize("preset", list(SENSORS))
def test_the_same_values_give_the_same_bytes(preset: str) -> None:
    drawn = sample_sensor(SensorSettings(preset=preset), 7, 3, 1)  # type: ignore[arg-type]
    image = noisy_image()
    before = image.copy()
    first = expose(image, drawn)
    assert (first == expose(image, drawn)).all()
    assert (image == before).all()
    assert (first != expose(image, replace(drawn, noise_seed=drawn.noise_seed + 1))).any()


def test_an_exr_file_gives_the_same_picture() -> None:
    """Half floats are what it keeps."""
    drawn = sample_sensor(SensorSettings(), 1, 2, 3)
    image = noisy_image() * 3
    assert (expose(image, drawn, 0.7) == expose(image.astype(np.float16).astype(np.float32), drawn, 0.7)).all()


def test_each_image_has_a_stream_of_its_own() -> None:
    settings = SensorSettings()
    drawn = [sample_sensor(settings, *place) for place in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))]
    drawn.append(sample_sensor(settings.model_copy(update={"variant": 1}), 0, 0, 0))
    assert len({spec.noise_seed for spec in drawn}) == len({spec.photons for spec in drawn}) == 5
    assert drawn[0] == sample_sensor(settings, 0, 0, 0)


def test_one_setting_changes_one_value() -> None:
    usual = sample_sensor(SensorSettings(), 0, 0, 0)
    other = sample_sensor(SensorSettings(sharpen=(5.0, 5.0)), 0, 0, 0)
    assert {key for key in asdict(usual) if getattr(usual, key) != getattr(other, key)} == {"sharpen"}


def test_values_lie_in_their_ranges() -> None:
    settings = SensorSettings()
    drawn = [sample_sensor(settings, 0, drop, 0) for drop in range(300)]
    for key in {field.name for field in fields(SensorSpec)} - {"noise_seed", "jpeg_quality"}:
        low, high = getattr(settings, key)
        values = [getattr(spec, key) for spec in drawn]
        assert low * (1 - 1e-12) <= min(values) <= max(values) <= high * (1 + 1e-12), key
    qualities = [spec.jpeg_quality for spec in drawn if spec.jpeg_quality is not None]
    assert 100 < len(qualities) < 200
    assert 70 <= min(qualities) <= max(qualities) <= 98
    assert np.median([spec.photons for spec in drawn]) == pytest.approx(2000, rel=0.25), "log-uniform"


def test_augmentation_draws_anew_from_its_generator() -> None:
    crop = noisy_image()[3:40, 5:50]
    settings = SensorSettings()
    rng = np.random.default_rng(1)
    first, second = capture(crop, settings, rng), capture(crop, settings, rng)
    assert first.dtype == np.uint8
    assert first.shape == crop.shape
    assert (first != second).any()
    assert (first == capture(crop, settings, np.random.default_rng(1))).all()
    assert (first == expose(crop, draw_sensor(settings, np.random.default_rng(1)))).all()


@pytest.mark.parametrize("shape", [(3, 3, 3), (3, 8, 3), (17, 5, 3)])
def test_small_crops_are_taken(shape: tuple[int, int, int]) -> None:
    drawn = replace(sample_sensor(SensorSettings(), 0, 0, 0), blur_px=3.0)
    assert expose(np.full(shape, 0.3, dtype=np.float32), drawn).shape == shape


def test_wild_light_is_taken() -> None:
    image = noisy_image()
    image[0, 0], image[20, 20], image[40, 40], image[50, 60] = -1.0, 1e6, np.nan, np.inf
    assert expose(image, replace(sample_sensor(SensorSettings(), 0, 0, 0), blur_px=0.5)).shape == image.shape


def test_without_a_sensor_the_picture_is_the_plain_one() -> None:
    image = noisy_image()
    assert (picture(image, 0.8, None) == tonemap(image, 0.8)).all()


# --- settings ---


def test_there_is_no_sensor_unless_asked_for() -> None:
    for recipe in (load_recipe(None), load_recipe(None, ["sensor=none"]), load_recipe(None, ["sensor=null"])):
        assert recipe.sensor is None
        assert dump_recipe(recipe)["sensor"] is None


def test_a_preset_sets_what_is_not_given_and_is_written_out() -> None:
    camera = load_recipe(None, ["sensor=primesense"])
    assert camera.sensor is not None
    assert camera.sensor.photons == (3000, 3000)
    assert Recipe.model_validate(dump_recipe(camera)) == camera
    mixed = load_recipe(None, ["sensor.preset=primesense", "sensor.photons=[500, 600]"]).sensor
    assert mixed is not None
    assert mixed.photons == (500, 600)
    assert mixed.model_copy(update={"photons": camera.sensor.photons}) == camera.sensor
    assert load_recipe(None, ["sensor=primesense", "sensor.photons=[500, 600]"]).sensor == mixed
    assert load_recipe(None, ["sensor=none", "sensor.variant=2"]) == load_recipe(None, ["sensor.variant=2"])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sensor.photons=[9000, 400]", r"sensor\.photons = \[9000, 400\]: min 9000\.0 is greater than max 400\.0"),
        ("sensor.jpeg_quality=[98, 70]", r"sensor\.jpeg_quality .* min 98 is greater than max 70"),
        ("sensor=kinect", r"sensor = 'kinect': unknown sensor; give none, ranges, primesense"),
        ("sensor.preset=kinect", r"sensor\.preset = 'kinect'"),
        ("sensor.fotons=[1, 2]", r"did you mean sensor\.photons\?"),
        ("sensor.photons=[0, 400]", r"0.* is outside 10\.\."),
        ("sensor.read_noise=0.1", r"expected a list"),
        ("sensor=[1, 2]", r"expected a mapping"),
        ("sensor=true", "unknown sensor; give none, ranges, primesense"),
    ],
)
def test_wrong_settings_are_told_in_one_line(override: str, message: str) -> None:
    with pytest.raises(RecipeError, match=message) as caught:
        load_recipe(None, [override])
    assert "\n" not in str(caught.value)
