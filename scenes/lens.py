"""Lens distortion after Brown and Conrady, and the one projection of points to pixels that the whole project uses.

A point (x, y, 1) in front of the camera is seen at K (x', y', 1), in OpenCV's notation and order of the coefficients

    r^2 = x^2 + y^2
    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

(https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html). Far from the axis such a polynomial may turn around and fold
the image over. Its Jacobian is symmetric; on a disc where it is positive definite the mapping is one to one (Gale and
Nikaido 1965). With p = sqrt(p1^2 + p2^2) its eigenvalues at the distance r from the axis are at least the lesser of
1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6 and 1 + k1 r^2 + k2 r^4 + k3 r^6, less 6 p r; the disc where that is positive is the
part of the plane that is seen (``reach``).

Needs NumPy only.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from synthetless.scenes.spec import NO_DISTORTION, Coefficients, Intrinsics

Floats = NDArray[np.float64]

_LEAST_STRETCH = 0.05
"""Where a lens shows less than this share of the size that a pinhole would, it is taken to fold the image."""
_FARTHEST = 100.0
"""Distance from the axis up to which points of the plane z = 1 are considered: 89.4 degrees."""
_NO_TERM = 1e-9
_GRID = 129
_MARGIN_PX = 4
"""Of the pinhole around what the frame shows: the outermost pixels are interpolated from so far outside."""
_MOST_PIXELS = 16
"""That a render may have for each pixel of the picture."""
_MOST_STEPS = 30
_TABLE = 2048
_LAST_STEP = 1e-10
"""Newton's method converges quadratically: after a step as small as this, rounding is all that is left."""
_RESIDUAL = 1e-10


def project(points: ArrayLike, K: ArrayLike, distortion: ArrayLike | None = None) -> Floats:
    """Pixel coordinates of points.

    Args:
        points: (..., P, 3) in the camera's frame, any unit.
        K: (..., 3, 3) camera matrix.
        distortion: (..., 5) coefficients k1, k2, p1, p2, k3; None for a pinhole.

    Returns:
        (..., P, 2) coordinates (u, v), of a point behind the camera as of its mirror image; as cv2.projectPoints gives
        them, so that one outside ``reach`` may come out anywhere. Not finite where z is 0.
    """
    seen, camera = np.asarray(points, dtype=np.float64), np.asarray(K, dtype=np.float64)
    if distortion is not None and np.any(distortion):
        bent = distorted(seen[..., :2] / seen[..., 2:], np.asarray(distortion, dtype=np.float64)[..., None, :])
        seen = np.concatenate([bent, np.ones_like(bent[..., :1])], axis=-1)
    homogeneous = np.einsum("...ij,...pj->...pi", camera, seen)
    pixels: Floats = homogeneous[..., :2] / homogeneous[..., 2:]
    return pixels


def distorted(points: ArrayLike, distortion: ArrayLike) -> Floats:
    """Where a lens shows points (..., 2) of the plane z = 1, in the same plane; ``distortion`` is (..., 5)."""
    x, y = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
    k1, k2, p1, p2, k3 = np.moveaxis(np.asarray(distortion, dtype=np.float64), -1, 0)
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx), y * radial + p1 * (r2 + 2 * yy) + 2 * p2 * xy], axis=-1
    )


def jacobian(points: ArrayLike, distortion: Coefficients) -> tuple[Floats, Floats, Floats]:
    """Derivatives dx'/dx, dx'/dy = dy'/dx and dy'/dy of ``distorted`` at points (..., 2)."""
    x, y = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    return (
        radial + slope * x * x + 2 * p1 * y + 6 * p2 * x,
        slope * x * y + 2 * p1 * x + 2 * p2 * y,
        radial + slope * y * y + 6 * p1 * y + 2 * p2 * x,
    )


def undistorted(points: ArrayLike, distortion: Coefficients) -> Floats:
    """The inverse of ``distorted`` within ``reach``, by Newton's method; NaN where nothing in reach is shown."""
    given = np.asarray(points, dtype=np.float64)
    if distortion == NO_DISTORTION:
        return given.copy()
    target, limit = given.reshape(-1, 2), reach(distortion)
    found = _nearly_undistorted(target, distortion, limit)
    moving = np.arange(len(target))
    for _ in range(_MOST_STEPS):
        at = found[moving]
        a, b, c = jacobian(at, distortion)
        off = distorted(at, distortion) - target[moving]
        step = np.stack([c * off[:, 0] - b * off[:, 1], a * off[:, 1] - b * off[:, 0]], axis=1)
        found[moving] = _within(at - step / (a * c - b * b)[:, None], limit)
        moving = moving[np.abs(found[moving] - at).max(axis=1) > _LAST_STEP]
        if not moving.size:
            break
    with np.errstate(invalid="ignore"):
        shown = np.abs(distorted(found, distortion) - target).max(axis=1) <= _RESIDUAL
    return np.where(shown[:, None], found, np.nan).reshape(given.shape)


@lru_cache(maxsize=16)
def reach(distortion: Coefficients) -> float:
    """Radius of the disc of the plane z = 1 on which the lens does not fold the image, at most ``_FARTHEST``."""
    k1, k2, p1, p2, k3 = distortion
    powers = np.array([_FARTHEST**power for power in (6, 4, 2, 1, 0)])
    smallest = 1.0  # of the farthest, as are the roots
    for stretch in ((7 * k3, 5 * k2, 3 * k1), (k3, k2, k1)):
        terms = powers * [*stretch, -6 * np.hypot(p1, p2), 1 - _LEAST_STRETCH]
        a, b, c, d, e = np.where(np.abs(terms) < _NO_TERM, 0.0, terms)
        roots = np.roots([a, 0, b, 0, c, d, e])
        real = roots[np.abs(roots.imag) <= _NO_TERM * np.abs(roots)].real
        smallest = min(smallest, *real[real > 0].tolist(), 1.0)
    return smallest * _FARTHEST


def undistorted_pixels(pixels: ArrayLike, K: ArrayLike, distortion: ArrayLike | None) -> Floats:
    """Where a pinhole camera with the same K (3, 3) would see what is seen at pixels (..., 2); as ``undistorted``."""
    given = np.asarray(pixels, dtype=np.float64)
    if distortion is None or not np.any(distortion):
        return given.copy()
    camera = np.asarray(K, dtype=np.float64)
    y = (given[..., 1] - camera[1, 2]) / camera[1, 1]
    x = (given[..., 0] - camera[0, 2] - camera[0, 1] * y) / camera[0, 0]
    k1, k2, p1, p2, k3 = np.asarray(distortion, dtype=np.float64).tolist()
    straight = undistorted(np.stack([x, y], axis=-1), (k1, k2, p1, p2, k3))
    return np.stack([straight @ camera[0, :2] + camera[0, 2], straight[..., 1] * camera[1, 1] + camera[1, 2]], axis=-1)


def directions(camera: Intrinsics, columns: ArrayLike, rows: ArrayLike) -> tuple[Floats, Floats]:
    """The viewing rays (x, y, 1) through pixel centres of a grid.

    Args:
        camera: the pinhole and its lens.
        columns: (w,) of the grid; may lie outside the image.
        rows: (h,) likewise.

    Returns:
        x and y, which broadcast to (h, w): (1, w) and (h, 1) of a pinhole, else both (h, w), NaN where no ray leads.
    """
    x = (np.asarray(columns) - camera.cx) / camera.fx
    y = (np.asarray(rows) - camera.cy) / camera.fy
    if camera.distortion == NO_DISTORTION:
        return x[None], y[:, None]
    straight = undistorted(np.stack(np.meshgrid(x, y), axis=-1), camera.distortion)
    return straight[..., 0], straight[..., 1]


def straight_points(camera: Intrinsics) -> Floats:
    """(H, W, 2) points (x, y) of the plane z = 1 that an image's pixels show."""
    grid = np.broadcast_arrays(*directions(camera, np.arange(camera.width), np.arange(camera.height)))
    return np.stack(grid, axis=-1)


def pinhole_around(camera: Intrinsics) -> Intrinsics:
    """The pinhole that sees all that a camera sees, at least as finely; without a lens, the camera itself."""
    if camera.distortion == NO_DISTORTION:
        return camera
    # A grid will do: what is shown is bounded by what the border shows, and between its points by the margin.
    columns, rows = (np.unique(np.linspace(0, side - 1, _GRID).round()) for side in (camera.width, camera.height))
    straight = np.stack(directions(camera, columns, rows), axis=-1)
    a, b, c = jacobian(straight, camera.distortion)
    scale = max(1.0, float((np.hypot((a - c) / 2, b) + (a + c) / 2).max()))
    fx, fy = scale * camera.fx, scale * camera.fy
    left, top = np.floor((straight * (fx, fy)).min(axis=(0, 1))).astype(int).tolist()
    right, bottom = np.ceil((straight * (fx, fy)).max(axis=(0, 1))).astype(int).tolist()
    width, height = right - left + 1 + 2 * _MARGIN_PX, bottom - top + 1 + 2 * _MARGIN_PX
    return Intrinsics(width, height, fx, fy, float(_MARGIN_PX - left), float(_MARGIN_PX - top))


def fault(camera: Intrinsics) -> str | None:
    """Why a camera's distortion cannot be used, if so: it folds the image, that is, shows two points at one pixel."""
    if camera.distortion == NO_DISTORTION:
        return None
    u, v = np.arange(-0.5, camera.width), np.arange(-0.5, camera.height)
    border = [(u, v[:1]), (u, v[-1:]), (u[:1], v), (u[-1:], v)]
    if all(np.isfinite(directions(camera, columns, rows)).all() for columns, rows in border):
        # What the border encloses is in reach, too: the mapping is continuous and one to one.
        pinhole = pinhole_around(camera)
        if pinhole.width * pinhole.height <= _MOST_PIXELS * camera.width * camera.height:
            return None
        return f"needs a render of {pinhole.width} x {pinhole.height} pixels; weaker distortion is needed"
    r = reach(camera.distortion)
    turned = max(np.hypot(*distorted([r * np.cos(a), r * np.sin(a)], camera.distortion)) for a in np.linspace(0, 6, 7))
    corners = np.stack(np.meshgrid((u[[0, -1]] - camera.cx) / camera.fx, (v[[0, -1]] - camera.cy) / camera.fy), axis=-1)
    farthest = float(np.hypot(corners[..., 0], corners[..., 1]).max())
    return (
        f"folds the image {turned:.3g} focal lengths from the principal point, inside the frame, whose corners are up "
        f"to {farthest:.3g} away; weaker distortion or a longer focal length is needed"
    )


def _nearly_undistorted(target: Floats, distortion: Coefficients, limit: float) -> Floats:
    """Where Newton's method begins: as if there were no tangential distortion, by a table of the radius."""
    k1, k2, _, _, k3 = distortion
    radius = limit * np.linspace(0, 1, _TABLE) ** 3
    r2 = radius * radius
    shown = radius * (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))
    length = np.sqrt(target[:, 0] * target[:, 0] + target[:, 1] * target[:, 1])
    straight: Floats = target * (np.interp(length, shown, radius) / np.maximum(length, 1e-300))[:, None]
    return straight


def _within(points: Floats, limit: float) -> Floats:
    """Points (N, 2), those farther than ``limit`` from the axis moved to that distance."""
    length = np.sqrt(points[:, 0] * points[:, 0] + points[:, 1] * points[:, 1])
    within: Floats = points * np.minimum(1.0, limit / np.maximum(length, 1e-300))[:, None]
    return within
