"""Exact geometry of an image without rendering it: depth, instance ids, silhouettes and what of them is visible.

Rays through the pixels' centres, (u, v) = (i, j), are cast at each mesh in its own frame, inside the window that its
convex hull projects to, beyond the border too: that gives the truncated part of a silhouette. Embree finds the
triangle, double precision the point on it. The table is intersected in closed form. A lens bends no more than the rays:
each leads through the point of the plane z = 1 that is seen at the pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from synthetless.annotation.instances import (
    BACKGROUND,
    Illumination,
    ImageAnnotation,
    InstanceAnnotation,
    MeshKey,
    PosedModel,
    Window,
    canvas_window,
    image_window,
    measure_instance,
    visible_within,
)
from synthetless.errors import UserError
from synthetless.extras import LazyModule
from synthetless.scenes.lens import directions, distorted, reach
from synthetless.scenes.spec import NO_DISTORTION, Intrinsics

if TYPE_CHECKING:
    from embreex import mesh_construction, rtcore, rtcore_scene
else:
    mesh_construction, rtcore, rtcore_scene = (
        LazyModule(f"embreex.{name}") for name in ("mesh_construction", "rtcore", "rtcore_scene")
    )

NEAR_CLIP_MM = 10.0
"""Nothing closer to the camera plane than this is seen; the rendering camera clips at the same distance."""

MISS = -1
"""Triangle number of a ray that meets nothing."""

_START_MARGIN_MM = 1.0
_NOWHERE = 1e9
"""For x and y of a pixel, outside the image, at which the lens shows nothing: such a ray meets nothing."""
_EDGE_SAMPLES = 33
_SHADOW_MARGIN_MM = 0.2
"""What lies so near to a point, on its way to the projector, is its own surface."""
_FAR_OUTSIDE_PX = 1e9
_NO_HEIGHT = 1e-9
"""A triangle this flat, as a share of its longest edge, has no normal in double precision, and no ray can hit it."""
_EDGE_ON = 0.05
"""Cosine below which an error of Embree's single precision (about 1e-4 mm across the ray) could move z noticeably."""


@dataclass(frozen=True, eq=False)
class Rays:
    """The viewing rays (x, y, 1) of a window of pixels, up to z = 1, camera frame.

    Attributes:
        window: the pixels.
        x, y: of shapes that broadcast to the window's: (1, w) and (h, 1) of a pinhole, (h, w) behind a lens.
    """

    window: Window
    x: NDArray[np.float64]
    y: NDArray[np.float64]

    @classmethod
    def through(cls, camera: Intrinsics, window: Window) -> Rays:
        """The rays through the pixels' centres, (u, v) = (i, j)."""
        image = image_window(camera)
        if camera.distortion != NO_DISTORTION and image.intersection(window) == window:
            rays, crop = _image_rays(camera), window.slices_in(image)
            return cls(window, rays.x[crop], rays.y[crop])
        x, y = directions(camera, np.arange(window.left, window.right), np.arange(window.top, window.bottom))
        return cls(window, np.where(np.isnan(x), _NOWHERE, x), np.where(np.isnan(y), _NOWHERE, y))

    @property
    def is_grid(self) -> bool:
        """Whether they are those of a pinhole: straight rows and columns."""
        return self.x.shape[0] == self.y.shape[1] == 1

    @property
    def lengths(self) -> NDArray[np.float64]:
        """(h, w) distance from the camera to z = 1 along each ray."""
        lengths: NDArray[np.float64] = np.sqrt(self.x**2 + (self.y**2 + 1.0))
        return lengths

    def in_model_frame(self, R_m2c: NDArray[np.float64]) -> NDArray[np.float64]:
        """(h, w, 3) all directions."""
        all_of_them: NDArray[np.float64] = self.x[..., None] * R_m2c[0] + (self.y[..., None] * R_m2c[1] + R_m2c[2])
        return all_of_them

    def at(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float64]:
        """(N, 3) directions of single pixels, camera frame."""
        x, y = (np.broadcast_to(of, self.window.shape)[rows, columns] for of in (self.x, self.y))
        return np.stack([x, y, np.ones(len(rows))], axis=1)


@lru_cache(maxsize=2)
def _image_rays(camera: Intrinsics) -> Rays:
    """All rays of an image behind a lens: undistorting them takes longer than casting them."""
    x, y = directions(camera, np.arange(camera.width), np.arange(camera.height))
    x.flags.writeable = y.flags.writeable = False
    return Rays(image_window(camera), x, y)


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

    def __init__(self, device: rtcore.EmbreeDevice, vertices_mm: ArrayLike, faces: ArrayLike) -> None:
        """Build the tree.

        Args:
            device: Embree's device.
            vertices_mm: (V, 3), model frame.
            faces: (F, 3) vertex numbers.

        Raises:
            UserError: shapes, coordinates or vertex numbers are unusable, or no triangle has an area.
        """
        vertices, triangles = _checked(vertices_mm, faces)
        corners = vertices[triangles]
        edges = corners - np.roll(corners, 1, axis=1)
        normals = np.cross(edges[:, 1], edges[:, 2])
        doubled_areas = np.linalg.norm(normals, axis=1)
        solid = doubled_areas > _NO_HEIGHT * np.square(edges).sum(axis=2).max(axis=1)
        if not solid.any():
            raise UserError(f"none of the mesh's {len(triangles)} triangles has an area; a surface is needed")
        used = corners[solid].reshape(-1, 3)
        self.center_mm: NDArray[np.float64] = (used.min(axis=0) + used.max(axis=0)) / 2
        self.vertices_mm: NDArray[np.float64] = vertices - self.center_mm
        self.faces: NDArray[np.int32] = triangles[solid]
        self.normals: NDArray[np.float64] = normals[solid] / doubled_areas[solid, None]
        self.offsets_mm: NDArray[np.float64] = _dot(self.normals, self.vertices_mm[self.faces[:, 0]])
        self.hull_mm = _hull_points(np.unique(used, axis=0) - self.center_mm)
        self.scene = rtcore_scene.EmbreeScene(device, robust=True)  # robust: no ray slips through between two triangles
        mesh_construction.TriangleMesh(self.scene, self.vertices_mm.astype(np.float32), self.faces)


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

    @property
    def nearest_mm(self) -> float:
        """No point of the mesh has a smaller z."""
        return float(self._to_camera(self.surface.hull_mm)[:, 2].min())

    def window(self, camera: Intrinsics) -> Window:
        """A window that holds every pixel that can show the mesh; may leave the image, empty if it is behind."""
        points = self._to_camera(self.surface.hull_mm)
        if points[:, 2].min() < NEAR_CLIP_MM:
            points = _clip_to_front(self._to_camera(_box_corners(self.surface.hull_mm)))
        if len(points) == 0:
            return Window(0, 0, 0, 0)
        u = camera.fx * points[:, 0] / points[:, 2] + camera.cx
        v = camera.fy * points[:, 1] / points[:, 2] + camera.cy
        if camera.distortion != NO_DISTORTION:
            u, v = _behind_lens(camera, u, v)
        bounds = np.clip([u.min(), v.min(), u.max(), v.max()], -_FAR_OUTSIDE_PX, _FAR_OUTSIDE_PX)
        left, top, right, bottom = (int(bound) for bound in [*np.floor(bounds[:2]), *np.ceil(bounds[2:])])
        return Window(left, top, right + 1, bottom + 1)

    def first_faces(self, rays: Rays) -> NDArray[np.int32]:
        """(h, w) the first triangle each ray meets, or MISS."""
        if 0 in rays.window.shape:
            return np.full(rays.window.shape, MISS, dtype=np.int32)
        origins, directions = self._in_tree(rays.in_model_frame(self.R_m2c).reshape(-1, 3))
        found: NDArray[np.int32] = self.surface.scene.run(origins, directions)
        return found.reshape(rays.window.shape)

    def first_hits(self, directions: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """The first triangles that single rays meet, or MISS, and z there, or inf.

        z is Embree's, in single precision: 1e-3 mm where the plane is not seen edge-on. ``depth_mm`` is exact, and
        takes half as long again.

        Args:
            directions: (N, 3) camera frame, z = 1.
        """
        if len(directions) == 0:
            return np.full(0, MISS, dtype=np.int32), np.zeros(0)
        found = self.surface.scene.run(*self._in_tree(directions @ self.R_m2c), output=True)
        z = np.where(found["primID"] == MISS, np.inf, self._start_mm + found["tfar"].astype(np.float64))
        return found["primID"], z

    @property
    def _start_mm(self) -> float:
        """z at which rays start: just before the mesh, which keeps the single-precision distances short."""
        return max(NEAR_CLIP_MM, self.nearest_mm - _START_MARGIN_MM)

    def _in_tree(self, directions: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Origins and directions (N, 3) for Embree of rays from the camera, model frame."""
        origins = self._start_mm * directions - self.t_center @ self.R_m2c
        return origins.astype(np.float32), directions.astype(np.float32)

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

    def blocks(self, source_mm: NDArray[np.float64], points_mm: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(N,) whether the mesh is between a source of light in the plane z = 0 and points (N, 3), camera frame."""
        ways = points_mm - source_mm
        blocked = np.zeros(len(ways), dtype=bool)
        hull = self._to_camera(self.surface.hull_mm) - source_mm
        near = np.arange(len(ways))
        if (
            hull[:, 2].min() >= NEAR_CLIP_MM
        ):  # then the mesh's outline, seen from the source, is within that of its hull
            bounds = hull[:, :2] / hull[:, 2:]
            seen = ways[:, :2] / ways[:, 2:]
            inside = (seen >= bounds.min(axis=0)) & (seen <= bounds.max(axis=0))
            near = np.flatnonzero(inside.all(axis=1) & (ways[:, 2] > hull[:, 2].min()))
        if near.size:
            length = np.linalg.norm(ways[near], axis=1)
            origin = (source_mm - self.t_center) @ self.R_m2c
            found = self.surface.scene.run(
                np.broadcast_to(origin, (len(near), 3)).astype(np.float32),
                (ways[near] @ self.R_m2c).astype(np.float32),
                dists=(1 - _SHADOW_MARGIN_MM / length).astype(np.float32),
                query="OCCLUDED",
            )
            blocked[near] = found != MISS
        return blocked

    def normals(self, faces: NDArray[np.int32]) -> NDArray[np.float64]:
        """(N, 3) unit normals of triangles, camera frame."""
        return self.surface.normals.take(faces, axis=0) @ self.R_m2c.T

    def to_model(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) model coordinates of points in the camera frame."""
        return (points_mm - self.t_center) @ self.R_m2c + self.surface.center_mm

    def _to_camera(self, centered_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        return centered_mm @ self.R_m2c.T + self.t_center


def _behind_lens(
    camera: Intrinsics, u: NDArray[np.float64], v: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels whose bounding box holds all that a lens shows of the bounding box of a pinhole's pixels.

    What a continuous mapping makes of a region is bounded by what it makes of its border: here the box's edges, where
    the lens shows them, else the edge of what it shows. Between two samples the border strays less than they are apart.
    """
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    (left, right), (top, bottom) = (x.min(), x.max()), (y.min(), y.max())
    border = np.linspace(
        [[left, top], [right, top], [right, bottom], [left, bottom]],
        [[right, top], [right, bottom], [left, bottom], [left, top]],
        _EDGE_SAMPLES,
    )
    points = border.transpose(1, 0, 2).reshape(-1, 2)
    limit = reach(camera.distortion)
    points = points * np.minimum(1.0, limit / np.maximum(np.linalg.norm(points, axis=1), 1e-300))[:, None]
    shown = distorted(points, camera.distortion) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    apart = np.abs(np.diff(shown, axis=0)).max()
    around = np.concatenate([shown - apart, shown + apart])
    return around[:, 0], around[:, 1]


def pixels_where(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of a 2-D mask's true pixels (numpy's own nonzero takes three times as long)."""
    return np.divmod(np.flatnonzero(mask), mask.shape[1])


def _checked(vertices_mm: ArrayLike, faces: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    vertices, triangles = np.asarray(vertices_mm, dtype=np.float64), np.asarray(faces, dtype=np.int32)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise UserError(f"vertices of shape {vertices.shape} are unusable; (V, 3) finite numbers are needed")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) == 0:
        raise UserError(f"faces of shape {triangles.shape} are unusable; (F, 3) vertex numbers are needed")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise UserError(
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


_SURELY_MM = 1e-6
"""More than rounding can move a point on the table."""


@dataclass(frozen=True, eq=False)
class Plane:
    """The table: the plane z = 0 of the world, or a square of it.

    Attributes:
        R_w2c: (3, 3) rotation, world to camera (OpenCV), as BOP's cam_R_w2c.
        t_w2c: (3,) translation, millimetres, as BOP's cam_t_w2c.
        half_size_mm: the table is |x|, |y| <= half_size_mm of the world; unbounded if None.
    """

    R_w2c: NDArray[np.float64]
    t_w2c: NDArray[np.float64]
    half_size_mm: float | None = None

    @property
    def normal(self) -> NDArray[np.float64]:
        """(3,) unit normal that faces the camera, camera frame."""
        up = self.R_w2c[:, 2]
        return -up if up @ self.t_w2c > 0 else up

    def depth_mm(self, rays: Rays) -> NDArray[np.float64]:
        """(h, w) z where each ray meets the table, inf where it does not."""
        up = self.R_w2c[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            z: NDArray[np.float64] = (up @ self.t_w2c) / _along(up, rays.x, rays.y)
            # What a pinhole's window shows of the plane is convex, and so is the table: the corners tell of all of it.
            if z.size and rays.is_grid:
                corners = z[np.ix_([0, -1], [0, -1])]
                if self._is_met(rays.x[:, [0, -1]], rays.y[[0, -1]], corners, _SURELY_MM).all():
                    return z
            return np.where(self._is_met(rays.x, rays.y, z), z, np.inf)

    def depth_along(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """(...) z where rays (..., 3), up to z = 1, meet the table, inf where they do not."""
        world = rays @ self.R_w2c
        origin = self.t_w2c @ self.R_w2c
        with np.errstate(divide="ignore", invalid="ignore"):
            z: NDArray[np.float64] = origin[2] / world[..., 2]
            met = np.isfinite(z) & (z >= NEAR_CLIP_MM)
            if self.half_size_mm is not None:
                met &= (np.abs(world[..., :2] * z[..., None] - origin[:2]) <= self.half_size_mm).all(axis=-1)
        return np.where(met, z, np.inf)

    def _is_met(
        self, x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64], margin_mm: float = 0.0
    ) -> NDArray[np.bool_]:
        """Whether points of the plane, on the rays (x, y, 1) of a grid, are in front of the camera and on the table."""
        met: NDArray[np.bool_] = np.isfinite(z) & (z >= NEAR_CLIP_MM + margin_mm)
        if self.half_size_mm is not None:
            origin = self.t_w2c @ self.R_w2c
            for axis in (0, 1):
                distance = np.abs(_along(self.R_w2c[:, axis], x, y) * z - origin[axis])
                met &= distance <= self.half_size_mm - margin_mm
        return met


class RayCaster:
    """Casts rays at a set of meshes and keeps the tree of each that was posed.

    It uses one thread. It cannot be pickled, nor used on both sides of a fork: give each process its own.
    """

    def __init__(self, meshes: Mapping[MeshKey, tuple[ArrayLike, ArrayLike]]) -> None:
        """Take the meshes; a tree is built when its mesh is first posed.

        Args:
            meshes: vertices (V, 3) in millimetres, model frame, and faces (F, 3), by role and object id.
        """
        self._meshes = meshes
        self._device = rtcore.EmbreeDevice()
        self._surfaces: dict[MeshKey, Surface] = {}

    def annotate(
        self,
        camera: Intrinsics,
        plane: Plane | None,
        instances: Sequence[PosedModel],
        occluders: Sequence[PosedModel | PosedSurface] = (),
        visibility_delta_mm: float = 0.0,
        normals: bool = False,
        object_coordinates: bool = False,
        projector_mm: ArrayLike | None = None,
    ) -> ImageAnnotation:
        """Measure one image. Of surfaces at exactly the same depth the first instance is seen, the table last.

        Args:
            camera: its pinhole and lens.
            plane: the table, or None.
            instances: what gets labels.
            occluders: what hides, but gets none.
            visibility_delta_mm: how far behind the nearest surface a point still counts as visible, along the ray, as
                bop_toolkit has it. With 0 an instance is visible exactly where it is the nearest surface.
            normals: also give the normals.
            object_coordinates: also give the object coordinates.
            projector_mm: (3,) where a depth camera's projector is, in the camera's plane z = 0, to tell what it lights;
                None for no projector.

        Raises:
            ValueError: the tolerance is negative, or a mesh is unknown.
            UserError: a mesh is unusable.
        """
        if not visibility_delta_mm >= 0:
            raise ValueError(f"visibility_delta_mm is {visibility_delta_mm}; a number >= 0 is needed")
        image, canvas = image_window(camera), canvas_window(camera)
        hits = [self._cast(camera, posed, canvas) for posed in instances]
        hits += [self._cast(camera, posed, image) for posed in occluders]
        scene = _NearestSurface(camera, hits, plane)
        return ImageAnnotation(
            depth_mm=np.where(np.isfinite(scene.depth_mm), scene.depth_mm, 0.0),
            instance_ids=np.where(scene.owner < len(instances), scene.owner, BACKGROUND),
            instances=tuple(scene.instance(number, visibility_delta_mm) for number in range(len(instances))),
            normals=scene.normals() if normals else None,
            object_coordinates_mm=scene.object_coordinates_mm(len(instances)) if object_coordinates else None,
            illumination=None
            if projector_mm is None
            else scene.illumination(Rays.through(camera, image), projector_mm),
        )

    def whole_coordinates_mm(
        self, camera: Intrinsics, posed: PosedModel
    ) -> tuple[Window, NDArray[np.bool_], NDArray[np.float64]]:
        """Where a body alone is met inside the image, whatever hides it.

        Returns:
            A window of the image, empty if the body is not in it; (h, w) over it, where the body is; and (h, w, 3)
            the point that is met, model frame, mm, 0 elsewhere.
        """
        hits = self._cast(camera, posed, image_window(camera))
        met = hits.faces != MISS
        rows, columns = pixels_where(met)
        points_mm = hits.rays.at(rows, columns) * hits.depth_mm[rows, columns, None]
        coordinates_mm = np.zeros((*met.shape, 3))
        coordinates_mm[rows, columns] = hits.body.to_model(points_mm)
        return hits.rays.window, met, coordinates_mm

    def surfaces(
        self, camera: Intrinsics, plane: Plane, bodies: Sequence[PosedModel | PosedSurface]
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """What is seen at the pixels' centres; errors as in ``annotate``.

        Returns:
            (H, W) the number of the nearest body, their count for the plane, -1 for nothing; and (H, W, 3) its normals
            as in ``annotate``.
        """
        image = image_window(camera)
        scene = _NearestSurface(camera, [self._cast(camera, posed, image) for posed in bodies], plane)
        return scene.owner, scene.normals()

    def surfaces_between(
        self,
        camera: Intrinsics,
        plane: Plane,
        bodies: Sequence[PosedModel | PosedSurface],
        pixels: NDArray[np.intp],
        offsets_px: NDArray[np.float64],
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """What is seen around the centres of some pixels; errors as in ``annotate``.

        Args:
            camera, plane, bodies: as for ``surfaces``.
            pixels: (N, 2) column and row.
            offsets_px: (K, 2) where the rays of each of them meet it, from its centre.

        Returns:
            (N, K) and (N, K, 3), as ``surfaces`` gives them for all pixels.
        """
        shape = len(pixels), len(offsets_px)
        at = pixels[:, None] + offsets_px
        rays = np.ones((*shape, 3))
        rays[..., 0], rays[..., 1] = (at[..., 0] - camera.cx) / camera.fx, (at[..., 1] - camera.cy) / camera.fy
        nearest = plane.depth_along(rays)
        owner = np.where(np.isfinite(nearest), np.int32(len(bodies)), np.int32(-1))
        normals = np.where((owner >= 0)[..., None], plane.normal, 0.0).astype(np.float32)
        for number, posed in enumerate(bodies):
            body = self.pose(posed)
            window = body.window(camera)
            inside = (pixels >= (window.left - 2, window.top - 2)) & (pixels < (window.right + 2, window.bottom + 2))
            chosen = np.flatnonzero(inside.all(axis=1))
            towards = rays[chosen].reshape(-1, 3)
            faces, depth_mm = body.first_hits(towards)
            hit = np.flatnonzero(depth_mm < nearest[chosen].ravel())
            place = chosen[hit // shape[1]], hit % shape[1]
            facing = body.normals(faces[hit])
            facing *= -np.copysign(1.0, _dot(facing, towards[hit]))[:, None]
            nearest[place], owner[place], normals[place] = depth_mm[hit], number, facing
        return owner, normals

    def pose(self, posed: PosedModel | PosedSurface) -> PosedSurface:
        """A mesh in front of the camera; errors as in ``annotate``."""
        if isinstance(posed, PosedSurface):
            return posed
        return PosedSurface.of(self._surface(posed.key), posed.R_m2c, posed.t_m2c)

    def unnamed(self, vertices_mm: ArrayLike, faces: ArrayLike) -> Surface:
        """The surface of a mesh that is not one of the caster's, to be posed as an occluder.

        Raises:
            UserError: it is unusable.
        """
        return Surface(self._device, vertices_mm, faces)

    def _cast(self, camera: Intrinsics, posed: PosedModel | PosedSurface, limits: Window) -> _Hits:
        body = self.pose(posed)
        window = limits.intersection(body.window(camera))
        faces = body.first_faces(Rays.through(camera, window))
        inside = image_window(camera).intersection(window)
        rays = Rays.through(camera, inside)
        faces_inside = faces[inside.slices_in(window)]
        return _Hits(body, window, faces != MISS, rays, faces_inside, body.depth_mm(rays, faces_inside))

    def _surface(self, key: MeshKey) -> Surface:
        if key not in self._surfaces:
            if key not in self._meshes:
                raise ValueError(f"no mesh for {_name(key)}; there are {', '.join(map(_name, self._meshes))}")
            try:
                self._surfaces[key] = Surface(self._device, *self._meshes[key])
            except ValueError as error:
                raise UserError(f"{_name(key)}: {error}") from None
        return self._surfaces[key]


@dataclass(frozen=True, eq=False)
class _Hits:
    """Where one body alone is met by the rays.

    Attributes:
        body: the posed mesh.
        window: on the canvas; holds the whole silhouette.
        silhouette: (h, w) bool over ``window``.
        rays: those of ``window`` that are inside the image; the other arrays are over them.
        faces: triangle numbers, or MISS.
        depth_mm: z, or inf.
    """

    body: PosedSurface
    window: Window
    silhouette: NDArray[np.bool_]
    rays: Rays
    faces: NDArray[np.int32]
    depth_mm: NDArray[np.float64]


class _NearestSurface:
    """The first surface behind every pixel of the image.

    Attributes:
        depth_mm: (H, W) its z, inf where there is none.
        owner: (H, W) int32, whose it is: index into the hits, their number for the plane, -1 for nothing.
    """

    def __init__(self, camera: Intrinsics, hits: Sequence[_Hits], plane: Plane | None) -> None:
        self._image, self._hits, self._plane = image_window(camera), hits, plane
        self.depth_mm = np.full(self._image.shape, np.inf)
        self.owner = np.full(self._image.shape, -1, dtype=np.int32)
        for number, hit in enumerate(hits):
            self._add(number, hit.depth_mm, hit.rays.window)
        if plane is not None:
            self._add(len(hits), plane.depth_mm(Rays.through(camera, self._image)), self._image)

    def _add(self, number: int, depth_mm: NDArray[np.float64], window: Window) -> None:
        crop = window.slices_in(self._image)
        nearer = depth_mm < self.depth_mm[crop]
        self.depth_mm[crop][nearer] = depth_mm[nearer]
        self.owner[crop][nearer] = number

    def instance(self, number: int, delta_mm: float) -> InstanceAnnotation:
        """Counts, boxes and masks of one body."""
        hit = self._hits[number]
        crop = hit.rays.window.slices_in(self._image)
        visible = self.owner[crop] == number
        if delta_mm > 0:
            visible = visible_within(hit.depth_mm, self.depth_mm[crop], hit.rays.lengths, delta_mm)
        return measure_instance(hit.silhouette, hit.window, visible, self._image)

    def normals(self) -> NDArray[np.float32]:
        """(H, W, 3) geometric unit normals that face the camera; 0 where there is no surface."""
        of_plane = np.zeros(3) if self._plane is None else self._plane.normal
        on_plane = self.owner == len(self._hits)
        result: NDArray[np.float32] = np.array([np.zeros(3), of_plane], dtype=np.float32).take(on_plane, axis=0)
        for number, hit in enumerate(self._hits):
            rows, columns = self._seen(number)
            normals = hit.body.normals(hit.faces[rows, columns])
            towards = -np.copysign(1.0, np.einsum("ij,ij->i", normals, hit.rays.at(rows, columns)))
            result[hit.rays.window.slices_in(self._image)][rows, columns] = normals * towards[:, None]
        return result

    def illumination(self, rays: Rays, projector_mm: ArrayLike) -> Illumination:
        """What a projector lights; see ``RayCaster.annotate``."""
        source = np.asarray(projector_mm, dtype=np.float64)
        rows, columns = pixels_where(np.isfinite(self.depth_mm))
        towards = rays.at(rows, columns)
        cosine, lit = np.zeros(self._image.shape, dtype=np.float32), np.zeros(self._image.shape, dtype=bool)
        facing = -np.einsum("ij,ij->i", self.normals()[rows, columns], towards)
        cosine[rows, columns] = facing / np.sqrt(np.einsum("ij,ij->i", towards, towards))
        free = np.ones(len(rows), dtype=bool)
        if source.any():  # a projector at the camera lights all that is seen
            points = towards * self.depth_mm[rows, columns, None]
            for hit in self._hits:
                free[free] = ~hit.body.blocks(source, points[free])
        lit[rows, columns] = free
        return Illumination(lit, cosine, self.owner)

    def object_coordinates_mm(self, n_bodies: int) -> NDArray[np.float32]:
        """(H, W, 3) model coordinates on the first bodies, 0 elsewhere."""
        result = np.zeros((*self._image.shape, 3), dtype=np.float32)
        for number, hit in enumerate(self._hits[:n_bodies]):
            rows, columns = self._seen(number)
            points = hit.rays.at(rows, columns) * hit.depth_mm[rows, columns, None]
            result[hit.rays.window.slices_in(self._image)][rows, columns] = hit.body.to_model(points)
        return result

    def _seen(self, number: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns, in the body's own window inside the image, where it is the nearest."""
        return pixels_where(self.owner[self._hits[number].rays.window.slices_in(self._image)] == number)


def _along(axis: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """(h, w) component of rays (x, y, 1) along an axis of the camera frame."""
    component: NDArray[np.float64] = x * axis[0] + (y * axis[1] + axis[2])
    return component


def _name(key: MeshKey) -> str:
    role, obj_id = key
    return f"{'object' if role == 'model' else role} {obj_id}"
