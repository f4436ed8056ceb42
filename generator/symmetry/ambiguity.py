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

import numpy as np
from numpy.typing import ArrayLike, NDArray

from synthetless.annotation.instances import PosedModel, Window, image_window
from synthetless.annotation.raycast import MISS, Plane, PosedSurface, RayCaster, Rays
from synthetless.errors import UserError
from synthetless.extras import cv2
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
SENSOR_MM = 15.0
"""What a depth image shows nearer than an object by more is another body: BOP's tolerance of visibility."""
THETA_DEG = 10.0
"""Normals that differ by more can be told apart by their shading."""

_MANY = 10
"""So many of a few pixels spare looking at all of them."""
_ALIKE = math.cos(math.radians(THETA_DEG))
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

    @classmethod
    def of(cls, body: PosedSurface, rays: Rays, what: What) -> View:
        """Cast every ray of a window."""
        rows, columns = np.divmod(np.arange(math.prod(rays.window.shape)), max(1, rays.window.shape[1]))
        depth_mm, normals = _cast(body, rays.at(rows, columns), what)
        shape = rays.window.shape
        return cls(depth_mm.reshape(shape), None if normals is None else normals.reshape(*shape, 3))


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
    in_front_of = _bordered(np.asarray(occluder_mm, np.float64), -np.inf)
    comparison = _Comparison(_Grid.of(true, what), _Grid.of(other, what), in_front_of, eps_mm)
    return comparison.count_apart(comparison.differing(np.flatnonzero(_inside(true.depth_mm.shape))))


def _cast(body: PosedSurface, directions: Floats, what: What) -> tuple[Floats, Floats | None]:
    """z (N,) along rays (N, 3), camera frame, and normals (N, 3) if they are compared; as in ``View``."""
    faces, depth_mm = body.first_hits(directions)
    if what != "normals":
        return depth_mm, None
    hit = np.flatnonzero(faces != MISS)
    found = body.normals(faces[hit])
    normals = np.zeros((len(faces), 3))
    normals[hit] = -np.copysign(1.0, np.einsum("ij,ij->i", found, directions[hit]))[:, None] * found
    return depth_mm, normals


@dataclass(frozen=True, eq=False)
class _Grid:
    """A view, or what was cast of it so far: its pixels row by row, with a border of one pixel.

    Attributes:
        columns: in a row, the border's included.
        depth_mm: (n,) NaN in the border and where nothing was cast.
        level: (n,) what is compared beside normals: the depth itself, or 0 and inf where only the outline counts.
        normals: (n, 3), or None unless they are compared.
    """

    columns: int
    depth_mm: Floats
    level: Floats
    normals: Floats | None

    @classmethod
    def of(cls, view: View, what: What) -> _Grid:
        """All of a view."""
        if what == "normals" and view.normals is None:
            raise ValueError("normals are to be compared, and there are none")
        grid = cls.empty(view.depth_mm.shape, what)
        normals = None if view.normals is None else view.normals.reshape(-1, 3)
        grid.put(np.flatnonzero(_inside(view.depth_mm.shape)), view.depth_mm.ravel(), normals)
        return grid

    @classmethod
    def empty(cls, shape: tuple[int, ...], what: What) -> _Grid:
        """Nothing of a window yet."""
        n = (shape[0] + 2) * (shape[1] + 2)
        depth_mm = np.full(n, np.nan)
        level = depth_mm if what == "depth" else np.full(n, np.nan)
        return cls(shape[1] + 2, depth_mm, level, np.zeros((n, 3)) if what == "normals" else None)

    def put(self, pixels: Integers, depth_mm: Floats, normals: Floats | None) -> None:
        """Add what was cast at pixels."""
        self.depth_mm[pixels] = depth_mm
        if self.level is not self.depth_mm:
            self.level[pixels] = np.where(np.isfinite(depth_mm), 0.0, np.inf)
        if self.normals is not None:
            self.normals[pixels] = normals

    def around(self, pixels: Integers) -> Integers:
        """(N, 9) pixels (N,) with their neighbours."""
        steps = np.arange(-1, 2)
        around: Integers = pixels[:, None] + (steps[:, None] * self.columns + steps).ravel()
        return around


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Two poses of an object, pixel by pixel.

    Attributes:
        true, other: the object alone.
        occluder_mm: (n,) z of the nearest other body.
        eps_mm: of depths.
    """

    true: _Grid
    other: _Grid
    occluder_mm: Floats
    eps_mm: float

    def differing(self, pixels: Integers) -> Integers:
        """Those of the pixels that count and at which the two differ, their neighbours left aside."""
        a, b = self.true.level[pixels], self.other.level[pixels]
        differ = (a < b - self.eps_mm) | (a > b + self.eps_mm)
        if self.true.normals is not None and self.other.normals is not None:
            cosine = np.einsum("ij,ij->i", self.true.normals[pixels], self.other.normals[pixels])
            differ |= np.isfinite(a) & np.isfinite(b) & (cosine < _ALIKE)
        nearer = np.fmin(self.true.depth_mm[pixels], self.other.depth_mm[pixels])
        return pixels[differ & (self.occluder_mm[pixels] > nearer)]

    def count_apart(self, differing: Integers) -> int:
        """At how many of such pixels one of the two shows what the other shows neither there nor at a neighbour."""
        apart = self._unexplained(self.true, self.other, differing) | self._unexplained(
            self.other, self.true, differing
        )
        return int(np.count_nonzero(apart))

    def count_certain(self, differing: Integers) -> int:
        """At how many of them the other pose shows such a thing, which can be said before its neighbours are cast."""
        return int(np.count_nonzero(self._unexplained(self.other, self.true, differing)))

    def _unexplained(self, view: _Grid, by: _Grid, pixels: Integers) -> Mask:
        around = by.around(pixels)
        level, near = view.level[pixels], by.level[around]
        low, high = np.fmin.reduce(near, axis=1), np.fmax.reduce(near, axis=1)
        apart: Mask = (level < low - self.eps_mm) | (level > high + self.eps_mm)
        if view.normals is not None and by.normals is not None:
            cosine = np.einsum("ij,ikj->ik", view.normals[pixels], by.normals[around])
            both = np.isfinite(level) & np.isfinite(by.level[pixels])
            apart |= both & (cosine.max(axis=1) < _ALIKE)
        return apart


def _bordered(values: NDArray[Any], border: float) -> NDArray[Any]:
    """(h, w) as pixels row by row, with a border of one pixel."""
    return np.pad(values, 1, constant_values=border).ravel()


def _inside(shape: tuple[int, ...]) -> Mask:
    """Of a window's pixels with their border, which are not in the border."""
    return _bordered(np.ones(shape, np.bool_), False)


# Images


@dataclass(frozen=True, eq=False)
class Ambiguity:
    """What an image tells of an instance.

    Attributes:
        coset_true: the coset of its pose.
        pixels_apart: (k,) at how many pixels each coset can be told from it; 0 at the true one. Large numbers are
            estimated from every eighth or second pixel, and single pixels away from all others may be missing.
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
    others: Sequence[PosedModel | PosedSurface] = (),
    plane: Plane | None = None,
    resolution: Resolution = Resolution(),
    depth_image_mm: Floats | None = None,
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
        depth_image_mm: (H, W) what a sensor measured, 0 where it measured nothing, to find bodies that nobody recorded;
            None if they are all known.
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
        view = View.of(surface, rays, resolution.what)
        if depth_image_mm is not None:
            measured_mm = depth_image_mm[window.slices_in(image_window(camera))]
            is_nearer = (measured_mm > 0) & (measured_mm < view.depth_mm - SENSOR_MM)
            occluder_mm = np.where(is_nearer, np.minimum(occluder_mm, measured_mm), occluder_mm)
        nearest_mm = min(body.nearest_mm for body in bodies)
        image = _Image.of(view, nearest_mm, rays, occluder_mm, resolution.what, eps_mm)
        for number, body in enumerate(bodies):
            if number != true:
                apart[number] = image.count_apart(body)
    return Ambiguity(true, apart, eps_mm, R, t)


@dataclass(frozen=True, eq=False)
class _Image:
    """What an image shows of an instance, to compare other poses of it with, of which as little is cast as will do.

    First every eighth pixel, then every second one, as on a chessboard, then those around each one that differs. A
    difference of two pixels that touch is never missed. Nothing is cast where another body hides both poses.

    Attributes:
        true: the object at its true pose.
        occluder_mm: (n,) z of the nearest other body.
        rays: of the window.
        stages: pixels that are cast one after the other, each with the rays through them.
        castable: (n,) the pixels that may count, and their neighbours.
        what, eps_mm: what is compared, and how finely.
    """

    true: _Grid
    occluder_mm: Floats
    rays: Rays
    stages: tuple[tuple[Integers, Floats], ...]
    castable: Mask
    what: What
    eps_mm: float

    @classmethod
    def of(cls, view: View, nearest_mm: float, rays: Rays, occluder_mm: Floats, what: What, eps_mm: float) -> _Image:
        """Of the view of its true pose; no pose of it reaches closer to the camera than ``nearest_mm``."""
        may_count = occluder_mm > np.minimum(view.depth_mm, nearest_mm)
        castable = np.asarray(cv2.dilate(may_count.astype(np.uint8), _NEIGHBOURS), np.bool_)
        rows, columns = (np.arange(length) for length in rays.window.shape)
        even = (rows[:, None] + columns) % 2 == 0
        first = ((rows % 2 == 0)[:, None]) & ((rows[:, None] + columns) % 4 == 0)
        stages = [np.flatnonzero(_bordered(castable & chosen, False)) for chosen in (first, even & ~first)]
        return cls(
            _Grid.of(view, what),
            _bordered(occluder_mm, -np.inf),
            rays,
            tuple((pixels, _directions(rays, pixels)) for pixels in stages),
            _bordered(castable, False),
            what,
            eps_mm,
        )

    def count_apart(self, body: PosedSurface) -> int:
        """``pixels_apart`` of another pose; where few pixels show that there are many, what those tell."""
        other = _Grid.empty(self.rays.window.shape, self.what)
        comparison = _Comparison(self.true, other, self.occluder_mm, self.eps_mm)
        differing, certain, cast = np.empty(0, np.int64), 0, 0
        for pixels, directions in self.stages:
            other.put(pixels, *_cast(body, directions, self.what))
            found = comparison.differing(pixels)
            differing, cast = np.concatenate([differing, found]), cast + len(pixels)
            certain += comparison.count_certain(found)
            if certain >= _MANY:
                return round(certain * np.count_nonzero(self.castable) / cast)
        found = differing
        while len(found):
            pixels = np.unique(other.around(found))
            pixels = pixels[self.castable[pixels] & np.isnan(other.depth_mm[pixels])]
            other.put(pixels, *_cast(body, _directions(self.rays, pixels), self.what))
            found = comparison.differing(pixels)
            differing = np.concatenate([differing, found])
        return comparison.count_apart(differing)


def _directions(rays: Rays, pixels: Integers) -> Floats:
    """(N, 3) the rays through pixels of a window with its border."""
    rows, columns = np.divmod(pixels, rays.window.shape[1] + 2)
    return rays.at(rows - 1, columns - 1)


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
