"""What a depth camera's projector lights: shadows are where geometry puts them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from synthetless.annotation.instances import ImageAnnotation, PosedModel
from synthetless.annotation.raycast import Plane, RayCaster
from synthetless.scenes.lens import straight_points
from synthetless.scenes.spec import Intrinsics

CAMERA = Intrinsics(240, 180, 300.0, 300.0, 119.5, 89.5)
SIDE, TOP_MM, TABLE_MM = 60.0, 440.0, 500.0
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])


def _seen(baseline_mm: float, camera: Intrinsics = CAMERA) -> ImageAnnotation:
    """A box on the table, from straight above, its top at ``TOP_MM``."""
    box = trimesh.creation.box((SIDE, SIDE, TABLE_MM - TOP_MM))
    caster = RayCaster({("model", 1): (box.vertices, box.faces)})
    posed = PosedModel(1, LOOKING_DOWN, np.array([10.0, -5.0, (TOP_MM + TABLE_MM) / 2]))
    table = Plane(LOOKING_DOWN, np.array([0.0, 0.0, TABLE_MM]))
    return caster.annotate(camera, table, [posed], projector_mm=(baseline_mm, 0, 0))


@pytest.mark.parametrize("baseline_mm", [75.0, -40.0, 150.0])
@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.25, 0.05, 0.01, 0.0, 0.0)])
def test_a_box_has_the_shadow_of_its_edge(baseline_mm: float, distortion: tuple[float, ...]) -> None:
    camera = dataclasses.replace(CAMERA, distortion=distortion)
    seen = _seen(baseline_mm, camera)
    assert seen.illumination is not None
    dark = ~seen.illumination.lit
    # The table's points whose way to the projector meets the box: between its sides and the top edges' projections.
    points = straight_points(camera) * TABLE_MM
    sides = np.array([10 - SIDE / 2, 10 + SIDE / 2])
    stretched = (TABLE_MM / TOP_MM) * (sides - baseline_mm) + baseline_mm
    low, high = min(sides[0], stretched[0]), max(sides[1], stretched[1])
    rows = np.abs(points[..., 1] + 5) < SIDE / 2
    expected = rows & (points[..., 0] > low) & (points[..., 0] < high) & (seen.instance_ids < 0)
    middle = np.abs(points[..., 1] + 5) < SIDE / 2 - 3
    np.testing.assert_array_equal(dark[middle], expected[middle])
    assert np.count_nonzero(expected[middle]) > 50
    assert seen.illumination.lit[seen.instance_ids == 0].mean() > 0.85, "the top, and what is seen of the sides"


def test_from_the_camera_itself_all_that_is_seen_is_lit() -> None:
    illumination = _seen(0.0).illumination
    assert illumination is not None
    assert illumination.lit.all()


def test_angles_are_those_to_the_normal() -> None:
    seen = _seen(75.0)
    assert seen.illumination is not None
    rays = np.concatenate([straight_points(CAMERA), np.ones((180, 240, 1))], axis=-1)
    straight_on = 1 / np.linalg.norm(rays, axis=-1)
    flat: NDArray[np.bool_] = (seen.depth_mm == TABLE_MM) | (np.abs(seen.depth_mm - TOP_MM) < 1e-6)
    assert flat.mean() > 0.9
    np.testing.assert_allclose(seen.illumination.cosine[flat], straight_on[flat], rtol=1e-5)
    owner = seen.illumination.owner
    assert set(np.unique(owner).tolist()) == {0, 1}
    np.testing.assert_array_equal(owner == 0, seen.instance_ids == 0)
