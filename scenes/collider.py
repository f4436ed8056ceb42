"""What rigid body physics needs to know of a mesh: a few convex pieces that hug it, its mass centre and its volume.

Bullet is fast and steady with convex shapes only, but hulls of whole parts would hold them apart by their hollows. So
the hull is cut, again and again at the plane that leaves least empty space in the halves' hulls, until nothing that
could be touched from outside is far from the true surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from synthetless.errors import UserError
from synthetless.scenes.contact import Surface
from synthetless.scenes.spec import Mesh, Standing

Array = NDArray[np.float64]
Remember = Callable[[Callable[[], dict[str, NDArray[Any]]]], Mapping[str, NDArray[Any]]]

VERSION = f"1-numpy{np.__version__}-scipy{scipy.__version__}"
"""Of the algorithm below, to be counted up with each change of its results, and of what their last bits depend on."""

MAX_PIECES = 24
HOLLOW_M = 0.002
"""A piece is cut when its hull spans hollows that reach deeper than this."""

SIMPLIFY_M = 0.0002
"""Corners of a piece are dropped as long as nothing sticks out further than this."""

_FEET_M, _STEADY_DEG, _FLATTER = (0.00005, 0.0005), 5.0, 1.2
"""A face to stand on: of points this near the ground, on a smooth part or on a rough one; it takes this tilt to topple
over its edges; and it is this much wider than what a ball as high has so near the ground."""

_TRIED_POINTS, _TRIED_GAPS = 300, 300
_KEPT_GAPS = 5000
"""Random points that stand for all of them while cuts are compared, and while pieces are."""


@dataclass(frozen=True, eq=False)
class Collider:
    """A mesh as physics sees it, in a frame with the model's axes and its origin at the mass centre.

    Attributes:
        surface: of the true mesh, in the model frame.
        pieces_m: corners (n, 3) of convex pieces whose union covers the surface.
        hull_m: corners (n, 3) of the convex hull.
        mass_centre_m: (3,) in the model frame, of a body filled evenly, sealed cavities included.
        volume_m3: of that body.
    """

    surface: Surface
    pieces_m: tuple[Array, ...]
    hull_m: Array
    mass_centre_m: Array
    volume_m3: float

    @property
    def radius_m(self) -> float:
        """Of the sphere about the mass centre that holds the mesh."""
        return float(np.linalg.norm(self.hull_m, axis=1).max())


def collider(mesh: Mesh, remember: Remember = lambda compute: compute()) -> Collider:
    """Prepare a mesh for physics.

    Args:
        mesh: of the true shape.
        remember: called with the function that does most of the work, about half a second; it returns what that
            returns, perhaps from an earlier time. What it keeps must be kept under the mesh and ``VERSION``.

    Raises:
        UserError: the mesh is flat.
    """
    if not len(mesh.faces) or np.linalg.matrix_rank(np.diff(mesh.vertices_m[np.unique(mesh.faces)], axis=0)) < 3:
        raise UserError("the mesh is flat; a body needs a volume to fall")
    surface = Surface(mesh)
    body = remember(lambda: _convex_body(surface))
    pieces = tuple(np.split(body["pieces_m"], np.cumsum(body["piece_sizes"])[:-1]))
    return Collider(surface, pieces, body["hull_m"], body["mass_centre_m"], float(body["volume_m3"]))


def standing(item: Collider) -> Standing | None:
    """How a body stands upright, z up if it can; None if it stands neither that way up nor the other."""
    points = item.surface.vertices_m
    for upside_down in (False, True):
        z, sign = (-points[:, 2], -1.0) if upside_down else (points[:, 2], 1.0)
        centre_m = float(sign * item.mass_centre_m[2] - z.min())
        for near_m in _FEET_M:
            foot = points[z < z.min() + near_m][:, :2] - item.mass_centre_m[:2]
            ball_m = math.sqrt(2 * near_m * centre_m)
            if _reach(foot) >= max(centre_m * math.tan(math.radians(_STEADY_DEG)), _FLATTER * ball_m):
                radius = float(np.linalg.norm(points[:, :2], axis=1).max())
                return Standing(upside_down, -float(z.min()), float(np.ptp(z)), radius)
    return None


def _reach(points: Array) -> float:
    """Distance from the origin to the border of the convex hull of (N, 2) points; negative if it lies outside."""
    try:
        return float(-ConvexHull(points).equations[:, 2].max())
    except (QhullError, ValueError):  # too few points, or all in one line
        return -math.inf


def _convex_body(surface: Surface) -> dict[str, NDArray[Any]]:
    """What a Collider holds besides the surface, as plain arrays: the pieces one after the other, and their sizes."""
    points = np.concatenate([surface.vertices_m, surface.points_m])
    voxels = _Voxels(surface.points_m, 2 * surface.spacing_m)
    centre, volume = voxels.mass()
    pieces = [_simplified(piece) - centre for piece in _convex_pieces(points, voxels)]
    return {
        "pieces_m": np.concatenate(pieces),
        "piece_sizes": np.array([len(piece) for piece in pieces]),
        "hull_m": _simplified(points) - centre,
        "mass_centre_m": centre,
        "volume_m3": np.array(volume),
    }


class _Voxels:
    """The space around a surface in cubes: on the surface, reachable from outside, or enclosed."""

    def __init__(self, points: Array, pitch: float) -> None:
        """Needs a sample within half a pitch of every point of the surface, or the inside would leak."""
        self.pitch = pitch
        self._origin = points.min(axis=0) - 1.5 * pitch
        cells = np.floor((points - self._origin) / pitch).astype(int)
        self._on_surface = np.zeros(cells.max(axis=0) + 2, dtype=bool)
        self._on_surface[tuple(cells.T)] = True
        regions, _ = ndimage.label(~self._on_surface)
        self._outside = regions == regions[0, 0, 0]

    def hollows(self, depth: float) -> Array:
        """(N, 3) centres of outside cubes further than ``depth`` from the surface."""
        distance = ndimage.distance_transform_edt(~self._on_surface) * self.pitch
        return self._centres(self._outside & (distance > depth))

    def mass(self) -> tuple[Array, float]:
        """Centre and volume of what is enclosed; cubes on the surface count half."""
        weights = np.where(self._on_surface, 0.5, 1.0)[~self._outside]
        volume = float(weights.sum() * self.pitch**3)
        return np.average(self._centres(~self._outside), axis=0, weights=weights), volume

    def _centres(self, which: NDArray[np.bool_]) -> Array:
        return np.asarray(self._origin + (np.argwhere(which) + 0.5) * self.pitch)


@dataclass(frozen=True, eq=False)
class _Cell:
    """A box of space with the surface points in it, and the hollows that their hull spans."""

    low: Array
    high: Array
    points: Array
    hollows: Array

    def halves(self, axis: int, cut: float, overlap: float) -> tuple[_Cell, _Cell]:
        high, low = self.high.copy(), self.low.copy()
        high[axis], low[axis] = cut + overlap, cut - overlap
        return self._part(self.low, high), self._part(low, self.high)

    def _part(self, low: Array, high: Array) -> _Cell:
        points, hollows = (p[((p >= low) & (p <= high)).all(axis=1)] for p in (self.points, self.hollows))
        return _Cell(low, high, points, _spanned(points[:1000], hollows))


def _convex_pieces(points: Array, voxels: _Voxels) -> Iterator[Array]:
    rng = np.random.default_rng(0)  # in random order, the first so many are a fair sample
    points = rng.permutation(points)
    hollows = rng.permutation(voxels.hollows(max(HOLLOW_M, 1.5 * voxels.pitch)))[:_KEPT_GAPS]
    everywhere = np.full(3, np.inf)
    cells = [_Cell(-everywhere, everywhere, points, _spanned(points[:1000], hollows))]
    done: list[_Cell] = []
    while cells and len(cells) + len(done) < MAX_PIECES:
        cells.sort(key=lambda cell: len(cell.hollows))
        cell = cells.pop()
        cut = _best_cut(cell, voxels.pitch) if len(cell.hollows) else None
        if cut is None:
            done.append(cell)
        else:
            cells.extend(cell.halves(*cut, overlap=voxels.pitch / 2))
    for cell in cells + done:
        yield cell.points


def _best_cut(cell: _Cell, pitch: float) -> tuple[int, float] | None:
    """Axis and place of the cut whose halves span least hollow space; near the middle when it matters little."""
    points, hollows = cell.points[:_TRIED_POINTS], cell.hollows[:_TRIED_GAPS]
    best: tuple[float, int, float] | None = None
    for axis in range(3):
        low, high = cell.points[:, axis].min(), cell.points[:, axis].max()
        along = hollows[:, axis]
        for cut in (along.min() - pitch, along.max() + pitch, *np.quantile(along, [0.25, 0.5, 0.75])):
            if not low + pitch < cut < high - pitch:
                continue
            below, hollow_below = points[:, axis] <= cut, along <= cut
            left = len(_spanned(points[below], hollows[hollow_below]))
            left += len(_spanned(points[~below], hollows[~hollow_below]))
            cost = left + 0.02 * len(hollows) * abs(cut - (low + high) / 2) / (high - low)
            if best is None or cost < best[0]:
                best = (cost, axis, float(cut))
    return best and best[1:]


def _spanned(points: Array, hollows: Array) -> Array:
    """The hollows inside the hull of some points."""
    try:
        planes = ConvexHull(points).equations
    except (QhullError, ValueError):
        return hollows[:0]  # too few points, or all in one plane: that spans nothing
    return np.asarray(hollows[(hollows @ planes[:, :3].T + planes[:, 3] <= 0).all(axis=1)])


def _simplified(points: Array) -> Array:
    """Corners of a hull that no point sticks out of further than ``SIMPLIFY_M``."""
    corners = points[_hull(points).vertices]
    grid = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    kept = np.unique((corners @ grid[grid.any(axis=1)].T).argmax(axis=0))
    if len(kept) < 4:  # too slender to simplify
        return np.asarray(corners)
    while True:
        planes = _hull(corners[kept]).equations
        heights = corners @ planes[:, :3].T + planes[:, 3]
        further = np.setdiff1d(heights.argmax(axis=0)[heights.max(axis=0) > SIMPLIFY_M], kept)
        if not len(further):
            return np.asarray(corners[kept])
        kept = np.union1d(kept, further)


def _hull(points: Array) -> ConvexHull:
    try:
        return ConvexHull(points)
    except QhullError:
        return ConvexHull(points, qhull_options="QJ")  # all in one plane: joggled out of it a little
