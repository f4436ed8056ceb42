"""One triangle mesh to cast rays at: Embree finds the triangle, double precision finds the point on it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from generator.visibility import Window
from scenes.spec import Intrinsics

NEAR_CLIP_MM = 10.0
"""Nothing closer to the camera plane than this is seen; the rendering camera clips at the same distance."""

MISS = -1
"""Triangle number of a ray that meets nothing."""

_START_MARGIN_MM = 1.0
_FAR_OUTSIDE_PX = 1e9
_NO_HEIGHT = 1e-9
"""A triangle this flat, as a share of its longest edge, has no normal in double precision, and no ray can hit it."""
_EDGE_ON = 0.05
"""Cosine below which an error of Embree's single precision (about 1e-4 mm across the ray) could move z noticeably."""


@dataclass(frozen=True, eq=False)
class Rays:
    """The viewing rays of a window of pixels, up to z = 1: (x[i], y[j], 1) in the camera frame."""

    window: Window
    x: NDArray[np.float64]
    y: NDArray[np.float64]

    @classmethod
    def through(cls, camera: Intrinsics, window: Window) -> Rays:
        """The rays through the pixels' centres, (u, v) = (i, j)."""
        x = (np.arange(window.left, window.right) - camera.cx) / camera.fx
        y = (np.arange(window.top, window.bottom) - camera.cy) / camera.fy
        return cls(window, x, y)

    @property
    def lengths(self) -> NDArray[np.float64]:
        """(h, w) distance from the camera to z = 1 along each ray."""
        lengths: NDArray[np.float64] = np.sqrt(self.x**2 + (self.y**2 + 1.0)[:, None])
        return lengths

    def in_model_frame(self, R_m2c: NDArray[np.float64]) -> NDArray[np.float64]:
        """(h, w, 3) all directions."""
        directions: NDArray[np.float64] = self.x[:, None] * R_m2c[0] + (self.y[:, None] * R_m2c[1] + R_m2c[2])[:, None]
        return directions

    def at(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float64]:
        """(N, 3) directions of single pixels, camera frame."""
        return np.stack([self.x[columns], self.y[rows], np.ones(len(rows))], axis=1)


class Surface:
    """A mesh and its ray-casting tree, built once.

    The mesh is kept relative to the centre of its box, so that single precision is fine wherever its origin is.

    Attributes:
        center_mm: (3,) centre of the box, model frame.
        vertices_mm: (V, 3) relative to the centre.
        faces: (F, 3) the triangles that have an area.
        normals: (F, 3) unit normals, oriented by the order of the vertices.
        offsets_mm: (F,) distance of each triangle's plane from the centre, along its normal.
        hull_mm: (P, 3) points relative to the centre whose convex hull holds the mesh.
        scene: Embree's tree over ``faces``.
    """

    def __init__(self, device: EmbreeDevice, vertices_mm: ArrayLike, faces: ArrayLike) -> None:
        """Build the tree.

        Args:
            device: Embree's device.
            vertices_mm: (V, 3), model frame.
            faces: (F, 3) vertex numbers.

        Raises:
            ValueError: shapes, coordinates or vertex numbers are unusable, or no triangle has an area.
        """
        vertices, triangles = _checked(vertices_mm, faces)
        corners = vertices[triangles]
        edges = corners - np.roll(corners, 1, axis=1)
        normals = np.cross(edges[:, 1], edges[:, 2])
        doubled_areas = np.linalg.norm(normals, axis=1)
        solid = doubled_areas > _NO_HEIGHT * np.square(edges).sum(axis=2).max(axis=1)
        if not solid.any():
            raise ValueError(f"none of the mesh's {len(triangles)} triangles has an area; a surface is needed")
        used = corners[solid].reshape(-1, 3)
        self.center_mm: NDArray[np.float64] = (used.min(axis=0) + used.max(axis=0)) / 2
        self.vertices_mm: NDArray[np.float64] = vertices - self.center_mm
        self.faces: NDArray[np.int32] = triangles[solid]
        self.normals: NDArray[np.float64] = normals[solid] / doubled_areas[solid, None]
        self.offsets_mm: NDArray[np.float64] = _dot(self.normals, self.vertices_mm[self.faces[:, 0]])
        self.hull_mm = _hull_points(np.unique(used, axis=0) - self.center_mm)
        self.scene = EmbreeScene(device, robust=True)  # robust: no ray slips through between two triangles
        TriangleMesh(self.scene, self.vertices_mm.astype(np.float32), self.faces)


@dataclass(frozen=True, eq=False)
class PosedSurface:
    """A surface in front of the camera.

    Attributes:
        surface: the mesh.
        R_m2c: (3, 3) rotation, model to camera.
        t_center: (3,) where the centre of the model's box is, camera frame, millimetres.
    """

    surface: Surface
    R_m2c: NDArray[np.float64]
    t_center: NDArray[np.float64]

    @classmethod
    def of(cls, surface: Surface, R_m2c: ArrayLike, t_m2c: ArrayLike) -> PosedSurface:
        """Pose a surface by BOP's R_m2c and t_m2c (mm)."""
        R = np.asarray(R_m2c, dtype=np.float64)
        return cls(surface, R, R @ surface.center_mm + np.asarray(t_m2c, dtype=np.float64))

    def window(self, camera: Intrinsics) -> Window:
        """A window that holds every pixel that can show the mesh; may leave the image, empty if it is behind."""
        points = self._to_camera(self.surface.hull_mm)
        if points[:, 2].min() < NEAR_CLIP_MM:
            points = _clip_to_front(self._to_camera(_box_corners(self.surface.hull_mm)))
        if len(points) == 0:
            return Window(0, 0, 0, 0)
        u = camera.fx * points[:, 0] / points[:, 2] + camera.cx
        v = camera.fy * points[:, 1] / points[:, 2] + camera.cy
        bounds = np.clip([u.min(), v.min(), u.max(), v.max()], -_FAR_OUTSIDE_PX, _FAR_OUTSIDE_PX)
        left, top, right, bottom = (int(bound) for bound in [*np.floor(bounds[:2]), *np.ceil(bounds[2:])])
        return Window(left, top, right + 1, bottom + 1)

    def first_faces(self, rays: Rays) -> NDArray[np.int32]:
        """(h, w) the first triangle each ray meets, or MISS."""
        if 0 in rays.window.shape:
            return np.full(rays.window.shape, MISS, dtype=np.int32)
        # Starting just before the mesh instead of at the camera keeps the single-precision distances short.
        start = max(NEAR_CLIP_MM, float(self._to_camera(self.surface.hull_mm)[:, 2].min()) - _START_MARGIN_MM)
        directions = rays.in_model_frame(self.R_m2c).reshape(-1, 3)
        origins = start * directions - self.t_center @ self.R_m2c
        found: NDArray[np.int32] = self.surface.scene.run(origins.astype(np.float32), directions.astype(np.float32))
        return found.reshape(rays.window.shape)

    def depth_mm(self, rays: Rays, faces: NDArray[np.int32]) -> NDArray[np.float64]:
        """(h, w) z where each ray crosses the plane of its triangle, inf where it has none."""
        rows, columns = pixels_where(faces != MISS)
        hit = faces[rows, columns]
        normals = self.normals(hit)
        slopes = _dot(normals, rays.at(rows, columns))
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (self.surface.offsets_mm.take(hit) + normals @ self.t_center) / slopes
        # A plane seen nearly edge-on has no well-defined crossing: keep z within the triangle's own range.
        edge_on = np.flatnonzero(np.abs(slopes) < _EDGE_ON)
        corner_z = self.surface.vertices_mm[self.surface.faces[hit[edge_on]]] @ self.R_m2c[2] + self.t_center[2]
        z[edge_on] = np.fmax(np.fmin(z[edge_on], corner_z.max(axis=1)), corner_z.min(axis=1))
        depth = np.full(faces.shape, np.inf)
        depth[rows, columns] = z
        return depth

    def normals(self, faces: NDArray[np.int32]) -> NDArray[np.float64]:
        """(N, 3) unit normals of triangles, camera frame."""
        return self.surface.normals.take(faces, axis=0) @ self.R_m2c.T

    def to_model(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) model coordinates of points in the camera frame."""
        return (points_mm - self.t_center) @ self.R_m2c + self.surface.center_mm

    def _to_camera(self, centered_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        return centered_mm @ self.R_m2c.T + self.t_center


def pixels_where(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of a 2-D mask's true pixels (numpy's own nonzero takes three times as long)."""
    return np.divmod(np.flatnonzero(mask), mask.shape[1])


def _checked(vertices_mm: ArrayLike, faces: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    vertices, triangles = np.asarray(vertices_mm, dtype=np.float64), np.asarray(faces, dtype=np.int32)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise ValueError(f"vertices of shape {vertices.shape} are unusable; (V, 3) finite numbers are needed")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) == 0:
        raise ValueError(f"faces of shape {triangles.shape} are unusable; (F, 3) vertex numbers are needed")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(
            f"faces name vertices {triangles.min()} to {triangles.max()}, but the mesh has 0 to {len(vertices) - 1}"
        )
    return vertices, triangles


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    product_sum: NDArray[np.float64] = np.einsum("ij,ij->i", a, b)
    return product_sum


def _hull_points(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points on the convex hull, or the box's corners if the mesh is flat."""
    try:
        on_hull: NDArray[np.float64] = points[ConvexHull(points).vertices]
        return on_hull
    except QhullError:
        return _box_corners(points)


def _box_corners(points: NDArray[np.float64]) -> NDArray[np.float64]:
    limits = np.stack([points.min(axis=0), points.max(axis=0)])
    return np.array(list(product(*limits.T)), dtype=np.float64)


def _clip_to_front(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points whose convex hull holds that part of the corners' hull that is in front of the near plane.

    The cut is spanned by the crossings of all segments from a corner in front to one behind; none if all are behind.
    """
    in_front = corners[:, 2] >= NEAR_CLIP_MM
    front, behind = corners[in_front][:, None], corners[~in_front][None]
    share = (NEAR_CLIP_MM - front[..., 2:]) / (behind[..., 2:] - front[..., 2:])
    crossings = front + share * (behind - front)
    return np.concatenate([corners[in_front], crossings.reshape(-1, 3)])
