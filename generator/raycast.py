"""Exact geometry of an image without rendering it: depth, instance ids, silhouettes and what of them is visible.

Rays through the pixels' centres, (u, v) = (i, j), are cast at each mesh in its own frame, inside the window that its
convex hull projects to, beyond the border too: that gives the truncated part of a silhouette. The table is
intersected in closed form.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from embreex.rtcore import EmbreeDevice
from numpy.typing import ArrayLike, NDArray

from generator.annotation import BACKGROUND, ImageAnnotation, InstanceAnnotation, PosedModel
from generator.surface import MISS, NEAR_CLIP_MM, PosedSurface, Rays, Surface, pixels_where
from generator.visibility import Window, canvas_window, image_window, measure_instance, visible_within
from scenes.spec import Intrinsics

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
            # What a window shows of the plane is convex, and so is the table: with the corners all of it is there.
            ends = [0, -1]
            if z.size and self._is_met(rays.x[ends], rays.y[ends], z[np.ix_(ends, ends)], _SURELY_MM).all():
                return z
            return np.where(self._is_met(rays.x, rays.y, z), z, np.inf)

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


@dataclass(frozen=True, eq=False)
class Occluder:
    """A mesh that hides what is behind it but has no label.

    Attributes:
        key: of its mesh.
        R_m2c: (3, 3) rotation, model to camera.
        t_m2c: (3,) translation, millimetres.
    """

    key: Hashable
    R_m2c: NDArray[np.float64]
    t_m2c: NDArray[np.float64]


class RayCaster:
    """Casts rays at a set of meshes and keeps the tree of each that was posed.

    It uses one thread. It cannot be pickled, nor used on both sides of a fork: give each process its own.
    """

    def __init__(self, meshes: Mapping[Any, tuple[ArrayLike, ArrayLike]]) -> None:
        """Take the meshes; a tree is built when its mesh is first posed.

        Args:
            meshes: vertices (V, 3) in millimetres, model frame, and faces (F, 3), by key: the BOP id for objects that
                get labels, anything for occluders.
        """
        self._meshes = meshes
        self._device = EmbreeDevice()
        self._surfaces: dict[Hashable, Surface] = {}

    def annotate(
        self,
        camera: Intrinsics,
        plane: Plane | None,
        instances: Sequence[PosedModel],
        occluders: Sequence[Occluder] = (),
        visibility_delta_mm: float = 0.0,
        normals: bool = False,
        object_coordinates: bool = False,
    ) -> ImageAnnotation:
        """Measure one image. Of surfaces at exactly the same depth the first instance is seen, the table last.

        Args:
            camera: the pinhole.
            plane: the table, or None.
            instances: what gets labels; ``obj_id`` is the key of its mesh.
            occluders: what hides, but gets none.
            visibility_delta_mm: how far behind the nearest surface a point still counts as visible, along the ray, as
                bop_toolkit has it. With 0 an instance is visible exactly where it is the nearest surface.
            normals: also give the normals.
            object_coordinates: also give the object coordinates.

        Raises:
            ValueError: the tolerance is negative, or a mesh is unknown or unusable.
        """
        if not visibility_delta_mm >= 0:
            raise ValueError(f"visibility_delta_mm is {visibility_delta_mm}; a number >= 0 is needed")
        image, canvas = image_window(camera), canvas_window(camera)
        hits = [self._cast(camera, posed.obj_id, posed.R_m2c, posed.t_m2c, canvas) for posed in instances]
        hits += [self._cast(camera, posed.key, posed.R_m2c, posed.t_m2c, image) for posed in occluders]
        scene = _NearestSurface(camera, hits, plane)
        return ImageAnnotation(
            depth_mm=np.where(np.isfinite(scene.depth_mm), scene.depth_mm, 0.0),
            instance_ids=np.where(scene.owner < len(instances), scene.owner, BACKGROUND),
            instances=tuple(scene.instance(number, visibility_delta_mm) for number in range(len(instances))),
            normals=scene.normals() if normals else None,
            object_coordinates_mm=scene.object_coordinates_mm(len(instances)) if object_coordinates else None,
        )

    def _cast(self, camera: Intrinsics, key: Hashable, R_m2c: ArrayLike, t_m2c: ArrayLike, limits: Window) -> _Hits:
        body = PosedSurface.of(self._surface(key), R_m2c, t_m2c)
        window = limits.intersection(body.window(camera))
        faces = body.first_faces(Rays.through(camera, window))
        inside = image_window(camera).intersection(window)
        rays = Rays.through(camera, inside)
        faces_inside = faces[inside.slices_in(window)]
        return _Hits(body, window, faces != MISS, rays, faces_inside, body.depth_mm(rays, faces_inside))

    def _surface(self, key: Hashable) -> Surface:
        if key not in self._surfaces:
            if key not in self._meshes:
                raise ValueError(f"no mesh for object {key!r}; there are {', '.join(map(repr, self._meshes))}")
            try:
                self._surfaces[key] = Surface(self._device, *self._meshes[key])
            except ValueError as error:
                raise ValueError(f"object {key!r}: {error}") from None
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
    """(h, w) component of the rays (x, y, 1) of a grid along an axis of the camera frame."""
    component: NDArray[np.float64] = x * axis[0] + (y * axis[1] + axis[2])[:, None]
    return component
