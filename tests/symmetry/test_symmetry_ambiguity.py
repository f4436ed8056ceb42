"""What an image tells of a nearly symmetrical pose: cosets, the analytic notch, and what holds for every object."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from notch import Notched
from symmetry_cases import random_rotations, seeds

from synthetless.annotation.instances import PosedModel, image_window
from synthetless.annotation.raycast import RayCaster, Rays
from synthetless.errors import UserError
from synthetless.scenes.spec import Intrinsics
from synthetless.symmetry import CanonicalMap, SymmetryGroup
from synthetless.symmetry.ambiguity import (
    FINEST_MM,
    MIN_PIXELS,
    WHATS,
    Ambiguity,
    Cosets,
    Resolution,
    View,
    What,
    nearest_depth_mm,
    pixels_apart,
    see,
)
from synthetless.symmetry.quaternions import from_axis_angle, multiply, to_matrix

CAMERA = Intrinsics(96, 96, 300.0, 300.0, 47.5, 47.5)
SO2 = SymmetryGroup("SO(2)")
COVER = PosedModel(3, np.eye(3), np.array([25.0, -20.0, 280.0]))
"""A box that hides a corner of what is at 350 mm."""
COARSE = Resolution(eps_mm=1.5)
FAR = Intrinsics(160, 128, 10_000.0, 10_000.0, 79.5, 63.5)
"""Nearly parallel rays, half a millimetre apart at FAR_MM."""
FAR_MM = 5000.0


def group(name: str, **where: object) -> SymmetryGroup:
    return SymmetryGroup.from_name(name, **where)  # type: ignore[arg-type]


# Cosets


@pytest.mark.parametrize(
    ("exact", "quasi", "count"),
    [
        (group("C1"), group("C2"), 2),
        (group("C2"), group("C4"), 2),
        (group("C2"), group("D2"), 2),
        (group("C3"), group("D3"), 2),
        (group("C4"), group("O"), 6),
        (group("T"), group("O"), 2),
        (group("C1"), group("I"), 60),
        (group("C1"), SO2, 24),
        (group("C5"), SO2, 5),
        (group("C30"), SO2, 1),
        (group("C1"), group("O(2)"), 48),
        (group("C2"), group("O(2)"), 24),
        (group("C2", axis=(1, 0, 0)), group("O(2)"), 24),
        (group("C2", axis=(0.6, 0.8, 0)), group("O(2)"), 24),
        (group("D3"), group("O(2)"), 8),
        (group("D2", axis=(1, 0, 0), secondary_axis=(0, 0.6, 0.8)), group("O(2)", axis=(0, 0.8, -0.6)), 12),
        (SO2, group("O(2)"), 2),
    ],
    ids=lambda value: value.name if isinstance(value, SymmetryGroup) else str(value),
)
def test_cosets_divide_the_group(exact: SymmetryGroup, quasi: SymmetryGroup, count: int) -> None:
    cosets = Cosets.of(quasi, exact)
    assert len(cosets) == max(count, 1)
    sizes = np.bincount(cosets.coset_of, minlength=len(cosets))
    assert (sizes == sizes[0]).all()
    assert cosets.first[0] == 0 and cosets.coset_of[0] == 0
    motions = to_matrix(cosets.elements_wxyz)
    assert quasi.appearance_distance_deg(np.broadcast_to(np.eye(3), motions.shape), motions).max() < 1e-6
    if exact.is_finite:  # h g is in the coset of h
        for g in exact.elements_wxyz:
            turned = to_matrix(multiply(cosets.elements_wxyz, g))
            np.testing.assert_array_equal(cosets.coset_of[cosets.element_nearest(turned)], cosets.coset_of)


def test_a_sphere_is_refused() -> None:
    with pytest.raises(UserError, match="give O, I or O"):
        Cosets.of(group("SO(3)"), group("C1"))


@settings(max_examples=30)
@given(seed=seeds, names=st.sampled_from([("C1", "C4"), ("C2", "D2"), ("C3", "O"), ("D2", "T"), ("C1", "D6")]))
def test_each_coset_has_one_pose_and_the_true_one_is_among_them(seed: int, names: tuple[str, str]) -> None:
    rng = np.random.default_rng(seed)
    exact, quasi = (group(name, offset_mm=(3, -2, 5)) for name in names)
    if not quasi.contains(exact):
        return
    cosets, labels = Cosets.of(quasi, exact), CanonicalMap(quasi)
    R, t = random_rotations(rng, 1)[0], np.array([10.0, 20.0, 600.0])
    canonical = labels(R[None], t[None])
    true, Rs, ts = cosets.candidates(R, t, canonical.R_m2c[0])
    np.testing.assert_allclose(Rs[true], R, atol=1e-12)
    np.testing.assert_allclose(ts[true], t, atol=1e-9)
    again = labels(Rs, ts)
    np.testing.assert_allclose(again.R_m2c, np.broadcast_to(canonical.R_m2c, Rs.shape), atol=1e-9)
    np.testing.assert_allclose(again.t_m2c, np.broadcast_to(canonical.t_m2c, ts.shape), atol=1e-6)
    for number, pose in enumerate(Rs):  # R = R_c h S with S in G
        relative = canonical.R_m2c[0].T @ pose
        h = to_matrix(cosets.representatives_wxyz[number])
        assert exact.appearance_distance_deg(h[None], relative[None])[0] < 1e-6


# The notch in closed form


def azimuthal_pose(azimuth_deg: float) -> np.ndarray:
    """Upright, the model's x axis turned so far from facing the camera."""
    upright = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])  # x towards the camera, y to the right, z up
    return upright @ to_matrix(from_axis_angle((0, 0, 1), np.radians(azimuth_deg)))


def analytic_view(notched: Notched, R: np.ndarray, camera: Intrinsics, z_mm: float) -> View:
    x, y = (np.arange(camera.width) - camera.cx) / camera.fx, (np.arange(camera.height) - camera.cy) / camera.fy
    rays = np.dstack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))])
    return View(notched.depth(R, np.array([0.0, 0.0, z_mm]), rays))


def columns_apart(notched: Notched, azimuth_deg: float, eps_mm: float, px_mm: float) -> float:
    """In how many columns a notch that faces the camera is deeper than what is seen of the whole cylinder nearby.

    Of the floor at azimuth a off the line of sight: x = q sin a, and it lies q cos a before the axis, where the
    cylinder, one pixel farther out, lies sqrt(r^2 - (|x| + 1 px)^2). The walls hide what lies behind their edges.
    """
    r, q = notched.radius_mm, notched.radius_mm - notched.depth_mm
    a = np.radians(np.linspace(-notched.half_width_deg, notched.half_width_deg, 2001) + azimuth_deg)
    x = q * np.sin(a)
    edges = r * np.sin(np.radians(azimuth_deg + np.array([-1, 1]) * notched.half_width_deg))
    seen = (np.cos(a) > 0) & (x > edges[0]) & (x < edges[1])
    deeper = np.sqrt(np.maximum(r**2 - (np.abs(x) + px_mm) ** 2, 0)) - q * np.cos(a)
    shown = np.sort(x[seen & (deeper > eps_mm)])
    return float(np.ptp(shown) / px_mm) if len(shown) else 0.0


@pytest.mark.parametrize("depth_mm", [0.2, 0.7, 0.9, 0.97, 1.03, 1.1, 1.3, 2.0, 4.0])
def test_the_analytic_notch_is_right_from_far_below_to_far_above_eps(depth_mm: float) -> None:
    notched, eps_mm, px_mm = Notched(depth_mm=depth_mm), 1.0, FAR_MM / FAR.fx
    faces = {a: analytic_view(notched, azimuthal_pose(a), FAR, FAR_MM) for a in (0, 8, -8, 180, 150, -140, 126)}
    occluder = np.full((FAR.height, FAR.width), np.inf)
    judged = 0
    for a, view in faces.items():
        for b, other in faces.items():
            if a == b or {abs(a), abs(b)} <= {0, 8}:  # both notches face the camera and overlap
                continue
            expected = max(columns_apart(notched, azimuth, eps_mm, px_mm) for azimuth in (a, b))
            if 0 < expected < 2:
                continue
            found = pixels_apart(view, other, occluder, "depth", eps_mm)
            assert (found < MIN_PIXELS) == (expected == 0), (a, b, found, expected)
            judged += 1
    assert judged >= 20


def test_a_notch_on_the_outline_is_seen_by_its_silhouette() -> None:
    notched = Notched(depth_mm=4.0)
    beside, behind = (analytic_view(notched, azimuthal_pose(a), FAR, FAR_MM) for a in (90, 180))
    nothing = np.full((FAR.height, FAR.width), np.inf)
    assert pixels_apart(beside, behind, nothing, "silhouette", 1.0) > 50
    assert pixels_apart(beside, behind, np.zeros_like(nothing), "silhouette", 1.0) == 0
    assert pixels_apart(behind, behind, nothing, "silhouette", 1.0) == 0


# Images of meshes


@pytest.fixture(scope="module")
def caster() -> RayCaster:
    two = Notched(azimuths_deg=(0.0, 180.0), half_width_deg=20.0, depth_mm=4.0)
    box = np.array([[x, y, z] for x in (-20.0, 20) for y in (-20.0, 20) for z in (-20.0, 20)])
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
                      [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
    one = Notched(half_width_deg=20.0, depth_mm=4.0)
    return RayCaster({("model", 1): one.mesh(2.0), ("model", 2): two.mesh(2.0), ("model", 3): (box, faces)})


def judged(
    caster: RayCaster,
    obj_id: int,
    R: np.ndarray,
    exact: SymmetryGroup,
    quasi: SymmetryGroup = SO2,
    others: tuple[PosedModel, ...] = (),
    resolution: Resolution = COARSE,
) -> Ambiguity:
    posed = PosedModel(obj_id, R, np.array([2.0, -1.0, 350.0]))
    canonical = CanonicalMap(quasi)(R[None], posed.t_m2c[None]).R_m2c[0]
    return see(caster, CAMERA, posed, canonical, Cosets.of(quasi, exact), others, None, resolution)


@pytest.mark.parametrize("what", ["depth", "normals"])
def test_a_notch_that_faces_away_leaves_the_image_ambiguous(caster: RayCaster, what: str) -> None:
    resolution = Resolution(what, 1.5)  # type: ignore[arg-type]
    facing = judged(caster, 1, azimuthal_pose(0), group("C1"), resolution=resolution)
    assert facing.alike.tolist() == [facing.coset_true] and facing.view_ambiguity == 1 / 24
    away = judged(caster, 1, azimuthal_pose(180), group("C1"), resolution=resolution)
    turns = np.degrees(np.arctan2(*(away.R_m2c[:, 0, 0] * [[-1]], away.R_m2c[:, 2, 0] * [[-1]]))).ravel()
    hidden = {number for number, turn in enumerate(turns) if abs(turn) > 90 + 20 + 2}
    shown = {number for number, turn in enumerate(turns) if abs(turn) < 60}
    assert len(hidden) >= 8 and len(shown) >= 7
    assert hidden <= set(away.alike.tolist()) and not shown & set(away.alike.tolist())


@settings(max_examples=20)
@given(azimuth=st.floats(-45, 45), elevation=st.floats(-60, 60), roll=st.floats(-180, 180))
def test_where_everything_is_visible_only_the_exact_group_looks_alike(
    caster: RayCaster, azimuth: float, elevation: float, roll: float
) -> None:
    tilt = to_matrix(from_axis_angle((1, 0, 0), np.radians(elevation)))
    R = to_matrix(from_axis_angle((0, 0, 1), np.radians(roll))) @ tilt @ azimuthal_pose(azimuth)
    for obj_id, exact in ((1, group("C1")), (2, group("C2"))):
        seen = judged(caster, obj_id, R, exact, group("C12"))
        assert seen.alike.tolist() == [seen.coset_true]


def test_what_hides_the_notch_makes_the_image_ambiguous(caster: RayCaster) -> None:
    R = azimuthal_pose(0)
    assert judged(caster, 1, R, group("C1"), group("C2")).view_ambiguity == 0.5
    cover = PosedModel(3, np.eye(3), np.array([2.0, -1.0, 280.0]))
    assert judged(caster, 1, R, group("C1"), group("C2"), (cover,)).view_ambiguity == 1
    behind = PosedModel(3, np.eye(3), np.array([2.0, -1.0, 450.0]))
    assert judged(caster, 1, R, group("C1"), group("C2"), (behind,)).view_ambiguity == 0.5


def test_a_depth_image_shows_what_hides_and_the_object_itself_does_not(caster: RayCaster) -> None:
    posed = PosedModel(1, azimuthal_pose(0), np.array([2.0, -1.0, 350.0]))
    cover = PosedModel(3, np.eye(3), np.array([2.0, -1.0, 280.0]))
    rays, quasi = Rays.through(CAMERA, image_window(CAMERA)), group("C2")
    R_canonical = CanonicalMap(quasi)(posed.R_m2c[None], posed.t_m2c[None]).R_m2c[0]
    noise = np.random.default_rng(1).normal(scale=3.0, size=(CAMERA.height, CAMERA.width))
    for bodies, expected in (([posed], 0.5), ([posed, cover], 1.0), ([], 0.5)):
        depth_mm = nearest_depth_mm([caster.pose(body) for body in bodies], None, CAMERA, rays)
        image_mm = np.where(np.isfinite(depth_mm), depth_mm + noise, 0.0)
        cosets = Cosets.of(quasi, group("C1"))
        seen = see(caster, CAMERA, posed, R_canonical, cosets, resolution=COARSE, depth_image_mm=image_mm)
        assert seen.view_ambiguity == expected


@pytest.mark.parametrize(
    ("obj_id", "axis", "name"), [(2, (0, 0, 1), "C12"), (2, (1, 0, 0), "D6"), (1, (1, 0, 0), "O(2)")]
)
@settings(max_examples=8)
@given(seed=seeds)
def test_what_holds_for_every_pose(
    caster: RayCaster, obj_id: int, axis: tuple[int, int, int], name: str, seed: int
) -> None:
    """G is in A(P); A(P g) = g^-1 A(P), which in numbers of cosets says A(P g) = A(P); monotone in eps, occluders."""
    rng = np.random.default_rng(seed)
    R, exact, quasi = random_rotations(rng, 1)[0], group("C2", axis=axis), group(name)
    seen = judged(caster, obj_id, R, exact, quasi)
    assert seen.coset_true in seen.alike
    turned = judged(caster, obj_id, R @ to_matrix(exact.elements_wxyz[1]), exact, quasi)
    assert turned.coset_true == seen.coset_true
    np.testing.assert_array_equal(turned.alike, seen.alike)
    for finer in (0.4, 1.0):
        fine = judged(caster, obj_id, R, exact, quasi, resolution=Resolution(eps_mm=finer))
        assert set(fine.alike) <= set(seen.alike)
    others: tuple[PosedModel, ...] = ()
    before = seen
    for _ in range(2):
        others += (PosedModel(3, random_rotations(rng, 1)[0], np.array([*rng.uniform(-30, 30, 2), 290.0])),)
        after = judged(caster, obj_id, R, exact, quasi, others)
        assert set(before.alike) <= set(after.alike)
        before = after


def every_pixel(
    caster: RayCaster, obj_id: int, R: np.ndarray, exact: SymmetryGroup, quasi: SymmetryGroup, resolution: Resolution
) -> np.ndarray:
    """``pixels_apart`` of every coset from all pixels of the image, with a box in front of a part of it."""
    t = np.array([2.0, -1.0, 350.0])
    canonical = CanonicalMap(quasi)(R[None], t[None]).R_m2c[0]
    true, *candidates = Cosets.of(quasi, exact).candidates(R, t, canonical)
    rays, bodies = (
        Rays.through(CAMERA, image_window(CAMERA)),
        [PosedModel(obj_id, *pose) for pose in zip(*candidates, strict=True)],
    )
    views = [View.of(caster.pose(body), rays, resolution.what) for body in bodies]
    occluder_mm = nearest_depth_mm([caster.pose(COVER)], None, CAMERA, rays)
    eps_mm = resolution.at(CAMERA, 350.0)
    return np.array([pixels_apart(views[true], view, occluder_mm, resolution.what, eps_mm) for view in views])


@pytest.mark.parametrize("what", WHATS)
@settings(max_examples=12)
@given(seed=seeds, quasi=st.sampled_from([SO2, group("D6"), group("O")]), eps_mm=st.sampled_from([0.3, 1.0, 3.0, 6.0]))
def test_the_pixels_that_are_cast_tell_what_all_of_them_tell(
    caster: RayCaster, what: What, seed: int, quasi: SymmetryGroup, eps_mm: float
) -> None:
    R, resolution = random_rotations(np.random.default_rng(seed), 1)[0], Resolution(what, eps_mm)
    for obj_id, exact in ((1, group("C1")), (2, group("C2")), (3, group("C2"))):
        quick = judged(caster, obj_id, R, exact, quasi, (COVER,), resolution)
        counts = every_pixel(caster, obj_id, R, exact, quasi, resolution)
        np.testing.assert_array_equal(quick.alike, np.flatnonzero(counts < MIN_PIXELS))
        few = quick.pixels_apart < 2 * 10  # no estimate is less
        np.testing.assert_allclose(quick.pixels_apart[few], counts[few], atol=1)
        shares = quick.pixels_apart[~few] / counts[~few]
        assert ((shares > 0.25) & (shares < 1.6)).all()


def test_an_object_without_any_detail_is_ambiguous_from_everywhere() -> None:
    plain = RayCaster({("model", 1): Notched(depth_mm=1e-3).mesh()})
    for R in random_rotations(np.random.default_rng(3), 6):
        assert judged(plain, 1, R, group("C1"), group("D4")).view_ambiguity == 1


def test_an_object_outside_the_image_tells_nothing(caster: RayCaster) -> None:
    for t in ([5000.0, 0, 400], [0.0, 0, -300]):
        posed = PosedModel(1, np.eye(3), np.array(t))
        seen = see(caster, CAMERA, posed, np.eye(3), Cosets.of(SO2, group("C1")))
        assert seen.view_ambiguity == 1 and seen.pixels_apart.sum() == 0


def test_resolution() -> None:
    assert Resolution().at(CAMERA, 30.0) == FINEST_MM
    assert Resolution().at(CAMERA, 600.0) == 2.0
    assert Resolution(eps_mm=0.1).at(CAMERA, 600.0) == 0.1
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(UserError, match="eps_mm is"):
            Resolution(eps_mm=wrong)
    with pytest.raises(UserError, match="use one of depth, normals, silhouette"):
        Resolution("colour")  # type: ignore[arg-type]
