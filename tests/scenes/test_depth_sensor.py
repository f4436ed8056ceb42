"""A depth camera's noise has the variance that its formula says, its steps and holes are where they should be."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from synthetless.scenes.depth_sensor import Returns, axial_noise_mm, sense, step_mm
from synthetless.scenes.sampling import sample_depth_sensor
from synthetless.scenes.settings import DEPTH_SENSORS, DepthSensorSettings
from synthetless.scenes.spec import DepthSensorSpec, Intrinsics

CAMERA = Intrinsics(400, 300, 1075.0, 1075.0, 199.5, 149.5)
PRESETS = {
    name: sample_depth_sensor(DepthSensorSettings.model_validate({"preset": name}), 1, 2, 3) for name in DEPTH_SENSORS
}


def _flat(z_mm: float, tilt_deg: float = 0.0, albedo: float = 0.8, lit: bool = True) -> Returns:
    """A surface of one depth, as if each pixel showed it under the same angle."""
    shape = (CAMERA.height, CAMERA.width)
    cosine = np.full(shape, np.cos(np.radians(tilt_deg)), dtype=np.float32)
    return Returns(np.full(shape, z_mm), np.full(shape, lit), cosine, np.full(shape, albedo, dtype=np.float32))


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("tilt_deg", [0.0, 45.0, 70.0])
@pytest.mark.parametrize("z_mm", [400.25, 700.25, 1000.25, 2000.25, 4000.25])
def test_the_noise_has_the_variance_of_its_formula(preset: str, z_mm: float, tilt_deg: float) -> None:
    drawn = dataclasses.replace(PRESETS[preset], speckle=0.0)
    measured = sense(_flat(z_mm, tilt_deg), CAMERA, drawn)
    assert (measured > 0).all()
    z, a = z_mm / 1000, np.radians(tilt_deg)
    if preset == "structured_light":  # Nguyen et al. 2012, and the steps of the disparity
        sigma = 1.2 + 1.9 * (z - 0.4) ** 2 + 0.1 / np.sqrt(z) * (a / (np.pi / 2 - a)) ** 2
        step = z_mm**2 * 0.125 / (1075 * 75)
    else:
        sigma, step = 0.5 + max(z - 0.5, 0.0), 1.0
    assert measured.var() == pytest.approx(sigma**2 + step**2 / 12, rel=0.02)
    assert measured.mean() == pytest.approx(z_mm, abs=5 * sigma / np.sqrt(measured.size) + sigma**2 / z_mm * 1.2)


def test_structured_light_measures_steps_of_disparity() -> None:
    drawn = PRESETS["structured_light"]
    levels = np.unique(sense(_flat(1500.0), CAMERA, drawn))
    levels = levels[levels > 0]
    disparity = 1075 * 75 / levels
    np.testing.assert_allclose(disparity / 0.125, np.rint(disparity / 0.125), atol=1e-9)
    apart = np.diff(levels[np.abs(levels - 1500) < 10]).mean()
    assert apart == pytest.approx(float(step_mm(np.array([1500.0]), CAMERA, drawn)[0]), rel=0.01)


def test_the_same_seed_gives_the_same_numbers_and_another_one_others() -> None:
    settings = DepthSensorSettings()
    first, again, other = (sample_depth_sensor(settings, 1, 2, view) for view in (0, 0, 1))
    assert first == again
    np.testing.assert_array_equal(sense(_flat(800.0), CAMERA, first), sense(_flat(800.0), CAMERA, again))
    assert (sense(_flat(800.0), CAMERA, first) != sense(_flat(800.0), CAMERA, other)).mean() > 0.5


@pytest.mark.parametrize("preset", PRESETS)
def test_what_sends_nothing_back_is_missing(preset: str) -> None:
    drawn = dataclasses.replace(PRESETS[preset], grazing_deg=80.0, dark=0.02, speckle=0.2)

    def share(seen: Returns) -> float:
        return float((sense(seen, CAMERA, drawn) > 0).mean())

    assert share(_flat(900.0)) == 1
    assert share(_flat(900.0, lit=False)) == 0
    assert share(_flat(0.0)) == 0
    assert share(_flat(900.0, tilt_deg=79.5)) > 0.999
    assert share(_flat(900.0, tilt_deg=80.5)) == 0
    assert share(_flat(900.0, albedo=0.008)) == 0
    assert share(_flat(900.0, albedo=0.02)) == pytest.approx(0.5, abs=0.02)
    assert share(_flat(900.0, albedo=0.03, tilt_deg=60.0)) == pytest.approx(0.05, abs=0.01)  # 0.015 is 1.67 sigma short
    assert share(_flat(6000.0)) == share(_flat(200.0)) == 0


def _edge(drawn: DepthSensorSpec) -> NDArray[np.float64]:
    """Left 700, right 900 mm."""
    seen = _flat(900.0)
    seen.depth_mm[:, :200] = 700.0
    return sense(seen, CAMERA, drawn)


def test_edges_are_ragged_as_wide_as_the_lateral_noise() -> None:
    drawn = dataclasses.replace(PRESETS["structured_light"], noise_mm=0.01, noise_growth_mm=0.0, speckle=0.0)
    near = _edge(drawn) < 800
    share = near.mean(axis=0)
    spread = -np.diff(share)
    place = np.arange(0.5, 399)
    mean = (spread * place).sum()
    assert mean == pytest.approx(199.5, abs=0.05)
    assert np.sqrt((spread * (place - mean) ** 2).sum()) == pytest.approx(np.hypot(0.8, np.sqrt(1 / 12)), rel=0.05)


def test_only_light_that_is_timed_mixes_depths() -> None:
    def between(preset: str) -> int:
        measured = _edge(PRESETS[preset])
        return int(np.count_nonzero((measured > 720) & (measured < 880)))

    assert between("structured_light") == 0
    assert between("time_of_flight") > 100


def test_the_noise_of_a_plane_seen_from_its_edge_is_finite() -> None:
    drawn = PRESETS["structured_light"]
    z, tilt = np.full(3, 800.0, np.float32), np.array([0.0, np.pi / 2, np.pi], np.float32)
    assert np.isfinite(axial_noise_mm(z, tilt, drawn)).all()
