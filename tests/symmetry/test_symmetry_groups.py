"""Groups: closed, with a fixed point, recognised from BOP's noisy fields, and refusing what is no rotation group."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from symmetry_cases import ALL, CONTINUOUS, FINITE, ORDERS, in_random_frame, random_generators, random_rotations, seeds

from synthetless.symmetry import SymmetryGroup
from synthetless.symmetry.quaternions import Floats, angle_deg, from_axis_angle, multiply, to_matrix

TLESS_CYLINDERS = {1, 2, 3, 4, 13, 14, 15, 16, 17, 24, 30}
TLESS_TRIVIAL = {18, 21, 22}


def same_elements(a: SymmetryGroup, b: SymmetryGroup, atol_deg: float) -> bool:
    distances = angle_deg(a.elements_wxyz[:, None], b.elements_wxyz[None])
    return len(a.elements_wxyz) == len(b.elements_wxyz) and distances.min(axis=1).max() < atol_deg


@pytest.mark.parametrize("name", FINITE)
def test_finite_groups_are_closed_and_fix_a_point(name: str) -> None:
    group = in_random_frame(name, np.random.default_rng(5))
    elements = group.elements_wxyz
    assert group.order == len(elements) == ORDERS[name]
    products = multiply(elements[:, None], elements[None]).reshape(-1, 4)
    to_nearest = angle_deg(products[:, None], elements[None])
    assert to_nearest.min(axis=1).max() < 1e-9
    assert ((to_nearest < 1e-6).sum(axis=1) == 1).all()
    c = np.array(group.offset_mm)
    motions = group.motions()
    np.testing.assert_allclose(motions[:, :3, :3] @ c + motions[:, :3, 3], np.tile(c, (len(motions), 1)), atol=1e-9)
    np.testing.assert_array_equal(elements[0], [1, 0, 0, 0])


@pytest.mark.parametrize("name", CONTINUOUS)
def test_continuous_groups(name: str) -> None:
    group = in_random_frame(name, np.random.default_rng(5))
    assert group.order == math.inf
    assert not group.is_finite
    with pytest.raises(ValueError, match="infinitely many"):
        _ = group.elements_wxyz
    sampled = group.sampled_wxyz(50)
    assert len(sampled) == (100 if name == "O(2)" else 50)
    np.testing.assert_allclose(np.linalg.norm(sampled, axis=1), 1)
    np.testing.assert_allclose(np.abs(sampled[0]), [1, 0, 0, 0], atol=1e-12)
    R = random_rotations(np.random.default_rng(1), 1)
    images = R @ to_matrix(sampled)
    assert group.appearance_distance_deg(np.repeat(R, len(images), 0), images).max() < 1e-6


@pytest.mark.parametrize("name", ALL)
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_bop_fields_give_the_group_back(name: str, seed: int) -> None:
    group = in_random_frame(name, np.random.default_rng(seed))
    fields = json.loads(json.dumps(group.to_bop()))
    assert len(fields.get("symmetries_discrete", [])) == {"O(2)": 1}.get(name, ORDERS.get(name, 1) - 1)
    back = SymmetryGroup.from_bop(fields)
    assert back.name == name
    assert_same_place(back, group, 1e-7, 1e-6)
    np.testing.assert_allclose(SymmetryGroup.from_bop(back.to_bop()).frame_wxyz, back.frame_wxyz, atol=1e-9)


def assert_same_place(a: SymmetryGroup, b: SymmetryGroup, atol_deg: float, atol_mm: float) -> None:
    if a.name != "C1":
        np.testing.assert_allclose(a.offset_mm, b.offset_mm, atol=atol_mm)
    if a.is_finite:
        assert same_elements(a, b, atol_deg)
    elif a.axis is not None:
        assert abs(np.array(a.axis) @ np.array(b.axis)) > np.cos(np.radians(max(atol_deg, 1e-5)))


@pytest.mark.parametrize("name", [n for n in FINITE if n != "C1"] + ["C60", "D30"])
@settings(max_examples=15, deadline=None)
@given(seed=seeds)
def test_noisy_generators_that_are_not_closed(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    group = in_random_frame(name, rng)
    noise = 1e-5 if name in ("C60", "D30") else 1e-4
    motions = group.motions()[random_generators(group, rng)]
    motions[:, :3, :3] += rng.normal(size=(len(motions), 3, 3)) * noise / 2
    motions[:, :3, 3] += rng.normal(size=(len(motions), 3)) * 1e-3
    nested = [m.tolist() if seed % 2 else m.ravel().tolist() for m in motions]
    found = SymmetryGroup.from_bop({"symmetries_discrete": nested})
    assert found.name == name
    assert_same_place(found, group, 0.1, 0.05)
    elements = found.elements_wxyz
    products = multiply(elements[:, None], elements[None]).reshape(-1, 4)
    assert angle_deg(products[:, None], elements[None]).min(axis=1).max() < 1e-9


def test_generator_order_and_repetition_do_not_matter() -> None:
    motions = in_random_frame("D3", np.random.default_rng(0)).to_bop()["symmetries_discrete"]
    a = SymmetryGroup.from_bop({"symmetries_discrete": motions})
    b = SymmetryGroup.from_bop({"symmetries_discrete": motions[::-1] + motions[:2] + [np.eye(4).ravel().tolist()]})
    assert same_elements(a, b, 1e-7)
    np.testing.assert_allclose(a.frame_wxyz, b.frame_wxyz, atol=1e-9)


def test_continuous_and_discrete_together() -> None:
    flip = np.diag([1.0, -1, -1, 1])
    flip[2, 3] = 10  # about the plane z = 5
    cylinder = {"axis": [0, 0, 2], "offset": [1, 2, 99]}
    closed = SymmetryGroup.from_bop({"symmetries_continuous": [cylinder], "symmetries_discrete": [_shift(flip, y=4)]})
    assert closed.name == "O(2)"
    assert closed.axis == (0, 0, 1)
    assert closed.offset_mm == pytest.approx((1, 2, 5))
    turn = np.eye(4)
    turn[:3, :3] = to_matrix(from_axis_angle((0, 0, 1), 1.0))
    turn[:3, 3] = np.array([1, 2, 0]) - turn[:3, :3] @ [1, 2, 0]
    kept = SymmetryGroup.from_bop({"symmetries_continuous": [cylinder], "symmetries_discrete": [turn.tolist()]})
    assert (kept.name, kept.offset_mm) == ("SO(2)", pytest.approx((1, 2, 0)))
    sphere = SymmetryGroup.from_bop({"symmetries_continuous": [cylinder, {"axis": [1, 0, 1], "offset": [1, 2, 7]}]})
    assert (sphere.name, sphere.offset_mm) == ("SO(3)", pytest.approx((1, 2, 7)))
    doubled = SymmetryGroup.from_bop({"symmetries_continuous": [cylinder, {"axis": [0, 0, -1], "offset": [1, 2, 0]}]})
    assert doubled.name == "SO(2)"


def _shift(motion: Floats, y: float) -> list[float]:
    shifted = motion.copy()
    shifted[1, 3] += y
    return [float(value) for value in shifted.ravel()]


def test_an_axis_and_its_opposite_are_one_group() -> None:
    assert SymmetryGroup.from_name("C3", axis=(0, 0, -2)) == SymmetryGroup.from_name("C3", axis=(0, 0, 1))
    assert SymmetryGroup.from_name("C2", offset_mm=(-7, 0, 5)).offset_mm == (-7, 0, 0)


def test_tless_groups_are_the_declared_ones(tless_models: Path) -> None:
    info = json.loads((tless_models / "models_info.json").read_text())
    groups = {int(key): SymmetryGroup.from_bop(entry) for key, entry in info.items()}
    assert len(groups) == 30
    for obj_id, group in groups.items():
        special = {27: "C4"} | dict.fromkeys(TLESS_CYLINDERS, "SO(2)") | dict.fromkeys(TLESS_TRIVIAL, "C1")
        assert group.name == special.get(obj_id, "C2"), obj_id
        for declared in info[str(obj_id)].get("symmetries_discrete", []):
            motion = np.array(declared).reshape(4, 4)
            distances = np.abs(group.motions() - motion).max(axis=(1, 2))
            assert distances.min() < 1e-4, obj_id
    assert groups[19].axis == groups[20].axis == groups[23].axis == (0, 1, 0)
    assert groups[25].offset_mm == groups[26].offset_mm == (-7, 0, 0)


def discrete(matrix: object) -> dict[str, object]:
    return {"symmetries_discrete": [matrix]}


def rotated(angle_deg: float, translation: tuple[float, float, float] = (0, 0, 0)) -> list[float]:
    motion = np.eye(4)
    motion[:3, :3] = to_matrix(from_axis_angle((0, 0, 1), np.radians(angle_deg)))
    motion[:3, 3] = translation
    return [float(value) for value in motion.ravel()]


def tilted_half_turn(tilt_deg: float) -> list[float]:
    motion = np.eye(4)
    tilt = np.radians(tilt_deg)
    motion[:3, :3] = to_matrix(from_axis_angle((np.sin(tilt), 0, np.cos(tilt)), np.pi))
    return [float(value) for value in motion.ravel()]


@pytest.mark.parametrize(
    ("info", "message"),
    [
        (discrete(np.diag([1.0, 1, -1, 1]).tolist()), "reflection"),
        (discrete(np.diag([2.0, 1, 1, 1]).tolist()), "not orthonormal"),
        (discrete([float("nan")] * 16), "not 16 finite numbers"),
        (discrete([1, 0, 0]), "not 16 finite numbers"),
        (discrete("C2"), "not 16 finite numbers"),
        ({"symmetries_discrete": "C2"}, "not a list"),
        (discrete([*np.eye(4).ravel()[:12], 0, 0, 1, 1]), "last row"),
        (discrete(rotated(180, (0, 0, 5))), "no common fixed point"),
        (discrete(rotated(0, (3, 0, 0))), "no common fixed point"),
        ({"symmetries_discrete": [rotated(180), rotated(180, (10, 0, 0))]}, "no common fixed point"),
        (discrete(rotated(37)), "no group of at most 120 rotations"),
        (discrete(rotated(1)), "no group of at most 120 rotations"),
        (discrete(rotated(np.degrees(1))), "no group of at most 120 rotations"),
        ({"symmetries_discrete": [rotated(180), np.diag([0.0, 0, 0, 1]).tolist()]}, "no rotation"),
        ({"symmetries_discrete": [rotated(180), tilted_half_turn(40.7)]}, "no group of at most 120 rotations"),
        ({"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0, 0, 0]}]}, "axis is zero"),
        ({"symmetries_continuous": [{"offset": [0, 0, 0]}]}, "axis, offset"),
        ({"symmetries_continuous": [{"axis": [0, 0, math.inf], "offset": [0, 0, 0]}]}, "3 finite numbers"),
        ({"symmetries_continuous": [{"axis": [0, 0, 1]}], "symmetries_discrete": [tilted_half_turn(40)]}, "tilts"),
        (
            {"symmetries_continuous": [{"axis": [0, 0, 1]}, {"axis": [1, 0, 0], "offset": [0, 9, 0]}]},
            "no common fixed point",
        ),
    ],
)
def test_what_is_no_rotation_group_is_refused_in_one_line(info: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        SymmetryGroup.from_bop(info)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("C0", {}, "order 0"),
        ("D0", {}, "order 0"),
        ("D1", {}, "'C2'"),
        ("C121", {}, "SO\\(2\\)"),
        ("D61", {}, "O\\(2\\)"),
        ("so2", {}, "did you mean 'SO\\(2\\)'"),
        ("c2", {}, "did you mean 'C2'"),
        ("cube", {}, "did you mean 'O'"),
        ("C2", {"axis": (0, 0, 0)}, "axis is zero"),
        ("C2", {"axis": (0, 0, math.nan)}, "3 finite numbers"),
        ("C2", {"axis": "z"}, "3 finite numbers"),
        ("C2", {"offset_mm": (0, 0)}, "3 finite numbers"),
        ("C1", {"axis": (0, 0, 1)}, "no axis"),
        ("C3", {"secondary_axis": (1, 0, 0)}, "one axis"),
        ("D3", {"axis": (0, 0, 1)}, "secondary_axis"),
        ("D3", {"axis": (0, 0, 1), "secondary_axis": (1, 0, 1)}, "perpendicular"),
        ("T", {"frame": np.diag([1.0, 1, -1])}, "reflection"),
        ("T", {"frame": np.eye(3), "axis": (0, 0, 1)}, "not both"),
    ],
)
def test_wrong_names_and_axes_are_refused_in_one_line(name: str, arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        SymmetryGroup.from_name(name, **arguments)
    assert "\n" not in str(caught.value)
