"""What an image can tell of the poses that nearly look alike: which cosets of the quasi-symmetry group it shows.

G is the exact group of an object, H the larger one that it has but for a detail. The pose P S, S in H, looks like P
where the detail is hidden in both. Whether it does is the same for all of a left coset S G, so one S per coset is
tried: the object alone is cast at both poses, and the pixels are counted at which they differ by more than can be seen
and at which no other body is in front of both. A(P) = the cosets of fewer than MIN_PIXELS such pixels. It holds G, and
A(P g) = g^-1 A(P) for g in G.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from synthetless.annotation.instances import PosedModel, Window, image_window
from synthetless.annotation.raycast import MISS, Plane, PosedSurface, RayCaster, Rays, pixels_where
from synthetless.errors import UserError
from synthetless.scenes.spec import Intrinsics
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.quaternions import Floats, conjugate, from_matrix, multiply, normalise, rotate, to_matrix

What = Literal["depth", "normals", "silhouette"]
WHATS: tuple[What, ...] = get_args(What)

MIN_PIXELS = 3
"""Poses that differ at fewer pixels look alike."""
SAMPLES = 24
"""Turns that stand for the turns of SO(2) and O(2), or the next number that the exact group's order divides."""
FINEST_MM = 0.3
"""No sensor is taken to resolve less, however near the object is."""
THETA_DEG = 10.0
"""Normals that differ by more can be told apart by their shading."""

_NEIGHBOURS = np.ones((3, 3), np.uint8)

Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]


# Cosets


@dataclass(frozen=True, eq=False)
class Cosets:
    """The left cosets h G of the exact group in the quasi-symmetry group.

    Attributes:
        quasi: H. If it is continuous, a finite subgroup stands for it that holds G, or what stands for G.
        elements_wxyz: (n, 4) of H or of what stands for it.
        coset_of: (n,) to which coset each element belongs; cosets are numbered in the order of their first elements,
            so that 0 is G.
        first: (k,) number of each coset's first element, which represents it.
    """

    quasi: SymmetryGroup
    elements_wxyz: Floats
    coset_of: Integers
    first: Integers

    @classmethod
    def of(cls, quasi: SymmetryGroup, exact: SymmetryGroup) -> Cosets:
        """The cosets of ``exact`` in ``quasi``, which contains it.

        Raises:
            UserError: the quasi-symmetry group is SO(3), for which no finite group can stand.
        """
        elements, subgroup = _finite(quasi, exact)
        coset_of = np.full(len(elements), -1)
        first: list[int] = []
        for number, element in enumerate(elements):
            if coset_of[number] < 0:
                coset_of[_nearest(elements, multiply(element, subgroup))] = len(first)
                first.append(number)
        return cls(quasi, elements, coset_of, np.array(first))

    def __len__(self) -> int:
        return len(self.first)

    @property
    def representatives_wxyz(self) -> Floats:
        """(k, 4) one element of each coset, the identity first."""
        return self.elements_wxyz[self.first]

    def element_nearest(self, rotations: Floats) -> Integers:
        """(N,) number of the element nearest to rotations (N, 3, 3) of the model."""
        return _nearest(self.elements_wxyz, from_matrix(rotations))

    def candidates(self, R_m2c: Floats, t_m2c: Floats, R_canonical: Floats) -> tuple[int, Floats, Floats]:
        """One pose of each coset, as seen from a pose.

        Args:
            R_m2c, t_m2c: (3, 3) and (3,) mm, the true pose.
            R_canonical: (3, 3) its canonical rotation under the quasi-symmetry group.

        Returns:
            The coset of the true pose, and for each coset h G the pose that looks like the canonical one turned by
            h, (k, 3, 3) and (k, 3) mm. If the group is continuous, these are the true pose turned by what stands for
            its turns, so that the true pose is among them in any case.
        """
        element = int(self.element_nearest((R_canonical.T @ R_m2c)[None])[0])
        true = int(self.coset_of[element])
        turns = multiply(conjugate(self.elements_wxyz[element]), self.representatives_wxyz)
        turns[true] = (1.0, 0.0, 0.0, 0.0)
        R = R_m2c @ to_matrix(turns)
        return true, R, t_m2c + (R_m2c - R) @ np.array(self.quasi.offset_mm)


def _finite(quasi: SymmetryGroup, exact: SymmetryGroup) -> tuple[Floats, Floats]:
    """Elements of the two groups, or of finite groups that stand for them."""
    if quasi.is_finite:
        return quasi.elements_wxyz, exact.elements_wxyz
    if quasi.axis is None:
        raise UserError("the quasi-symmetry group SO(3) cannot be sampled: give O, I or O(2) instead")
    axis = np.array(quasi.axis)
    if not exact.is_finite:  # SO(2) in O(2)
        turns = SymmetryGroup(f"C{SAMPLES}", quasi.axis, None, exact.offset_mm).elements_wxyz
        return SymmetryGroup(f"D{SAMPLES}", quasi.axis, _across(axis), quasi.offset_mm).elements_wxyz, turns
    along = rotate(exact.elements_wxyz, axis) @ axis
    n_turns, flips = int(np.count_nonzero(along > 0)), np.flatnonzero(along < 0)
    n = n_turns * math.ceil(SAMPLES / n_turns)
    if quasi.family == "SO(2)":
        return SymmetryGroup(f"C{n}", quasi.axis, None, quasi.offset_mm).elements_wxyz, exact.elements_wxyz
    across = _across(axis)
    if len(flips):
        vector = exact.elements_wxyz[flips[0], 1:]
        x, y, z = normalise(vector - (vector @ axis) * axis).tolist()
        across = (x, y, z)
    return SymmetryGroup(f"D{n}", quasi.axis, across, quasi.offset_mm).elements_wxyz, exact.elements_wxyz


def _across(axis: Floats) -> tuple[float, float, float]:
    x, y, z = normalise(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])).tolist()
    return x, y, z


def _nearest(elements: Floats, wxyz: Floats) -> Integers:
    return np.asarray(np.abs(wxyz @ elements.T).argmax(axis=-1), dtype=np.int64)


# Pixels


@dataclass(frozen=True)
class Resolution:
    """What of an image is compared, and how finely.

    Attributes:
        what: depth; normals and silhouette, for colour images; or the silhouette alone.
        eps_mm: depths that differ by more are told apart. None for what one pixel measures at the object, or
            ``FINEST_MM`` if that is less.
    """

    what: What = "depth"
    eps_mm: float | None = None

    def __post_init__(self) -> None:
        if self.what not in WHATS:
            raise UserError(f"unknown way to compare {self.what!r}: use one of {', '.join(WHATS)}")
        if self.eps_mm is not None and not 0 < self.eps_mm < math.inf:
            raise UserError(f"eps_mm is {self.eps_mm}; a number of mm > 0 is needed")

    def at(self, camera: Intrinsics, z_mm: float) -> float:
        """Its eps_mm for an object at a distance."""
        return max(FINEST_MM, z_mm / min(camera.fx, camera.fy)) if self.eps_mm is None else self.eps_mm


@dataclass(frozen=True, eq=False)
class View:
    """An object alone, as a window of pixels shows it.

    Attributes:
        depth_mm: (h, w) z, inf where it is not hit.
        normals: (h, w, 3) unit normals towards the camera, 0 where it is not hit; None unless they are compared.
    """

    depth_mm: Floats
    normals: Floats | None = None


def pixels_apart(true: View, other: View, occluder_mm: ArrayLike, what: What, eps_mm: float) -> int:
    """At how many pixels two poses of an object can be told apart.

    Those at which no other body is in front of both, and at which one of the two shows what the other does not show
    within ``eps_mm`` at the pixel or at one of its eight neighbours: along edges, what a shift by one pixel explains
    is not counted.

    Args:
        true, other: the object at the two poses.
        occluder_mm: (h, w) z of the nearest other body, inf where there is none.
        what: what is compared.
        eps_mm: of depths.
    """
    a, b = true.depth_mm, other.depth_mm
    differs = _unexplained(a, b, eps_mm) if what == "depth" else _unexplained(_flat(a), _flat(b), eps_mm)
    if what == "normals":
        if true.normals is None or other.normals is None:
            raise ValueError("normals are to be compared, and there are none")
        differs |= _bent(true.normals, other.normals, a, b)
    return int(np.count_nonzero(differs & (np.asarray(occluder_mm) > np.minimum(a, b))))


def _unexplained(a: Floats, b: Floats, eps_mm: float) -> Mask:
    (low_a, high_a), (low_b, high_b) = _range(a), _range(b)
    first = (a < low_b - eps_mm) | (a > high_b + eps_mm)
    return np.asarray(first | (b < low_a - eps_mm) | (b > high_a + eps_mm))


def _range(depth_mm: Floats) -> tuple[Floats, Floats]:
    """Least and greatest of each pixel and its neighbours inside the window."""
    return np.asarray(cv2.erode(depth_mm, _NEIGHBOURS)), np.asarray(cv2.dilate(depth_mm, _NEIGHBOURS))


def _flat(depth_mm: Floats) -> Floats:
    return np.where(np.isfinite(depth_mm), 0.0, np.inf)


def _bent(a: Floats, b: Floats, depth_a: Floats, depth_b: Floats) -> Mask:
    """Where both are hit, and none of the neighbours of one has a normal like that of the other."""
    both = np.isfinite(depth_a) & np.isfinite(depth_b)
    bent: Mask = both & (_unlike(a, b) | _unlike(b, a))
    return bent


def _unlike(a: Floats, b: Floats) -> Mask:
    h, w = a.shape[:2]
    around = np.pad(b, ((1, 1), (1, 1), (0, 0)))
    cosine = np.full((h, w), -1.0)
    for i in range(3):
        for j in range(3):
            np.maximum(cosine, np.einsum("ijk,ijk->ij", a, around[i : i + h, j : j + w]), out=cosine)
    return np.asarray(cosine < math.cos(math.radians(THETA_DEG)))


# Images


@dataclass(frozen=True, eq=False)
class Ambiguity:
    """What an image tells of an instance.

    Attributes:
        coset_true: the coset of its pose.
        pixels_apart: (k,) at how many pixels each coset can be told from it; 0 at the true one.
        eps_mm: how finely depths were compared.
        R_m2c, t_m2c: (k, 3, 3) and (k, 3) mm, the pose of each coset.
    """

    coset_true: int
    pixels_apart: Integers
    eps_mm: float
    R_m2c: Floats
    t_m2c: Floats

    @cached_property
    def alike(self) -> Integers:
        """The cosets that the image cannot tell from the true one, ascending."""
        return np.flatnonzero(self.pixels_apart < MIN_PIXELS)

    @property
    def view_ambiguity(self) -> float:
        """|A(P)| / |H|: 1 where nothing is visible of the detail."""
        return len(self.alike) / len(self.pixels_apart)


def see(
    caster: RayCaster,
    camera: Intrinsics,
    posed: PosedModel,
    R_canonical: Floats,
    cosets: Cosets,
    others: Sequence[PosedModel] = (),
    plane: Plane | None = None,
    resolution: Resolution = Resolution(),
) -> Ambiguity:
    """What an image tells of one of its objects.

    Args:
        caster: of every mesh.
        camera: the pinhole.
        posed: the object at its true pose.
        R_canonical: (3, 3) its canonical rotation under the quasi-symmetry group.
        cosets: of its groups.
        others: every other body in the image.
        plane: the table, or None.
        resolution: what is compared.
    """
    true, R, t = cosets.candidates(posed.R_m2c, posed.t_m2c, R_canonical)
    surface = caster.pose(posed)
    bodies = [PosedSurface.of(surface.surface, *pose) for pose in zip(R, t, strict=True)]
    window = image_window(camera).intersection(_padded(_union([body.window(camera) for body in bodies])))
    z_mm = float(posed.R_m2c[2] @ np.array(cosets.quasi.offset_mm) + posed.t_m2c[2])
    eps_mm = resolution.at(camera, z_mm)
    apart = np.zeros(len(bodies), np.int64)
    if 0 not in window.shape:
        rays = Rays.through(camera, window)
        occluder_mm = nearest_depth_mm([caster.pose(other) for other in others], plane, camera, rays)
        seen = _view(surface, rays, resolution.what)
        for number, body in enumerate(bodies):
            if number != true:
                view = _view(body, rays, resolution.what)
                apart[number] = pixels_apart(seen, view, occluder_mm, resolution.what, eps_mm)
    return Ambiguity(true, apart, eps_mm, R, t)


def nearest_depth_mm(bodies: Sequence[PosedSurface], plane: Plane | None, camera: Intrinsics, rays: Rays) -> Floats:
    """(h, w) z of the nearest of some bodies along each ray, inf where there is none."""
    window = rays.window
    nearest = np.full(window.shape, np.inf) if plane is None else plane.depth_mm(rays).copy()
    for body in bodies:
        part = window.intersection(body.window(camera))
        if 0 not in part.shape:
            through = Rays.through(camera, part)
            crop = part.slices_in(window)
            nearest[crop] = np.minimum(nearest[crop], body.depth_mm(through, body.first_faces(through)))
    return nearest


def _view(body: PosedSurface, rays: Rays, what: What) -> View:
    faces = body.first_faces(rays)
    depth_mm = body.depth_mm(rays, faces)
    if what != "normals":
        return View(depth_mm)
    rows, columns = pixels_where(faces != MISS)
    found = body.normals(faces[rows, columns])
    towards = -np.copysign(1.0, np.einsum("ij,ij->i", found, rays.at(rows, columns)))
    normals = np.zeros((*faces.shape, 3))
    normals[rows, columns] = found * towards[:, None]
    return View(depth_mm, normals)


def _union(windows: Sequence[Window]) -> Window:
    """The smallest window that holds all those that are not empty."""
    full = [window for window in windows if 0 not in window.shape]
    if not full:
        return Window(0, 0, 0, 0)
    sides: Any = np.array([(w.left, w.top, -w.right, -w.bottom) for w in full]).min(axis=0).tolist()
    return Window(sides[0], sides[1], -sides[2], -sides[3])


def _padded(window: Window) -> Window:
    if 0 in window.shape:
        return window
    return Window(window.left - 1, window.top - 1, window.right + 1, window.bottom + 1)
