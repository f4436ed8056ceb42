"""How far an estimated pose is from the true one: the errors of the BOP challenge.

VSD, MSSD and MSPD are those of Hodan et al., "BOP Challenge 2020 on 6D Object Localization" (ECCVW 2020), with the
conventions of bop_toolkit. Poses are BOP's: `x_cam = R_m2c x_model + t_m2c`, millimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError
from typing_extensions import Self

from synthetless.annotation.instances import Window, image_window
from synthetless.annotation.raycast import PosedSurface, Rays, Surface
from synthetless.scenes.lens import project
from synthetless.scenes.spec import Intrinsics

Floats = NDArray[np.float64]

CONTINUOUS_STEPS = 315
"""BOP's sampling of a continuous symmetry: no vertex moves by more than 1 % of the diameter from step to step."""
VISIBILITY_DELTA_MM = 15.0
"""BOP's tolerance of VSD's visibility masks."""
_BOUND_POINTS = 64


class RigidPose(NamedTuple):
    """R_m2c (3, 3) and t_m2c (3,) mm."""

    R_m2c: Floats
    t_m2c: Floats


def bop_motions(info: Mapping[str, Any]) -> Floats:
    """The motions (M, 4, 4), mm, that bop_toolkit counts as symmetries of an entry of models_info.json.

    The identity and the discrete ones as they are listed, each after every step of each continuous one.
    """
    discrete = [np.eye(4), *(np.reshape(motion, (4, 4)) for motion in info.get("symmetries_discrete") or [])]
    turns = [
        _turn(np.asarray(line["axis"], dtype=np.float64), np.asarray(line.get("offset", (0, 0, 0))), step)
        for line in info.get("symmetries_continuous") or []
        for step in range(CONTINUOUS_STEPS)
    ]
    if not turns:
        return np.stack(discrete)
    return np.stack([turn @ motion for motion in discrete for turn in turns])


def _turn(axis: Floats, offset_mm: Floats, step: int) -> Floats:
    """The turn (4, 4) by a number of steps about a line (Rodrigues' formula)."""
    angle = 2 * np.pi * step / CONTINUOUS_STEPS
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    motion = np.eye(4)
    motion[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    motion[:3, 3] = offset_mm - motion[:3, :3] @ offset_mm
    return motion


@dataclass(frozen=True, eq=False)
class ModelPoints:
    """An object's vertices and symmetries, for MSSD and MSPD.

    Attributes:
        vertices_mm: (V, 3).
        motions: (M, 4, 4) symmetries as rigid motions of the model, the identity among them.
    """

    vertices_mm: Floats
    motions: Floats

    def mssd(self, estimate: RigidPose, truth: RigidPose) -> float:
        """Largest distance of a vertex from its true place, mm, under the best symmetry.

        The distance is a convex function of the vertex, so that its largest value is on the convex hull.
        """
        R, t = self._looks_alike(truth)
        turned, moved = estimate.R_m2c - R, estimate.t_m2c - t
        bounds = _length(self._bounding_mm, turned, moved)
        return _least(bounds, lambda number: float(_length(self._hull_mm, turned[number], moved[number])))

    def mspd(self, estimate: RigidPose, truth: RigidPose, K: Floats, distortion: Floats | None = None) -> float:
        """Largest distance of a projected vertex from its true place, pixels, under the best symmetry.

        Args:
            estimate, truth: the poses.
            K: (3, 3) camera matrix.
            distortion: (5,) of the lens; None for a pinhole.
        """
        R, t = self._looks_alike(truth)
        few = self._bounding_mm
        bounds = _pixel_distance(_projected(few, K, distortion, *estimate), _projected(few, K, distortion, R, t))
        estimated = _projected(self.vertices_mm, K, distortion, *estimate)

        def exact(number: int) -> float:
            true = _projected(self.vertices_mm, K, distortion, R[number], t[number])
            return float(_pixel_distance(estimated, true))

        return _least(bounds, exact)

    def _looks_alike(self, pose: RigidPose) -> tuple[Floats, Floats]:
        """Rotations (M, 3, 3) and translations (M, 3) of all poses that look like one."""
        R, s = self.motions[:, :3, :3], self.motions[:, :3, 3]
        return pose.R_m2c @ R, s @ pose.R_m2c.T + pose.t_m2c

    @cached_property
    def _hull_mm(self) -> Floats:
        try:
            on_hull: Floats = self.vertices_mm[ConvexHull(self.vertices_mm).vertices]
            return on_hull
        except QhullError:  # flat
            return self.vertices_mm

    @cached_property
    def _bounding_mm(self) -> Floats:
        """Vertices on all sides: the extreme ones along evenly spread directions."""
        i = np.arange(_BOUND_POINTS) + 0.5
        z, angle = 1 - 2 * i / _BOUND_POINTS, np.pi * (1 + 5**0.5) * i
        directions = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])
        chosen: Floats = self._hull_mm[np.unique(np.argmax(self._hull_mm @ directions, axis=0))]
        return chosen


def _least(bounds: Floats, exact: Callable[[int], float]) -> float:
    """The smallest value of ``exact`` over the symmetries.

    Args:
        bounds: (M,) what a few vertices say of each: at most its value.
        exact: what all vertices say; asked only for symmetries that can still be the best.
    """
    best = np.inf
    for number in np.argsort(bounds, kind="stable"):
        if bounds[number] >= best:
            break
        best = min(best, exact(int(number)))
    return float(best)


def _length(points_mm: Floats, R: Floats, t: Floats) -> Floats:
    """(...) length of the longest of the vectors that (..., 3, 3), (..., 3) make of points (V, 3)."""
    vectors = points_mm @ np.swapaxes(R, -1, -2) + t[..., None, :]
    return np.asarray(np.sqrt(np.square(vectors).sum(axis=-1).max(axis=-1)))


def _projected(points_mm: Floats, K: Floats, distortion: Floats | None, R: Floats, t: Floats) -> Floats:
    """(..., V, 2) pixels of points (V, 3) under poses (..., 3, 3), (..., 3)."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return project(points_mm @ np.swapaxes(R, -1, -2) + t[..., None, :], K, distortion)


def _pixel_distance(a: Floats, b: Floats) -> Floats:
    """(...) largest distance of pixels (..., V, 2); inf where a point has no projection."""
    with np.errstate(invalid="ignore"):
        squared = np.square(a - b).sum(axis=-1).max(axis=-1)
    return np.asarray(np.sqrt(np.where(np.isnan(squared), np.inf, squared)))


@dataclass(frozen=True, eq=False)
class ObjectDepth:
    """The depth image of one posed object alone.

    Attributes:
        window: the pixels that can show it, inside the image.
        depth_mm: (h, w) z over the window, 0 beside the object.
    """

    window: Window
    depth_mm: Floats

    @classmethod
    def cast(cls, surface: Surface, pose: RigidPose, camera: Intrinsics) -> Self:
        """Measure it by casting a ray through the centre of each pixel."""
        body = PosedSurface.of(surface, pose.R_m2c, pose.t_m2c)
        rays = Rays.through(camera, image_window(camera).intersection(body.window(camera)))
        depth = body.depth_mm(rays, body.first_faces(rays))
        return cls(rays.window, np.where(np.isfinite(depth), depth, 0.0))

    def over(self, window: Window) -> Floats:
        """The depth image over a window that contains this one."""
        depth = np.zeros(window.shape)
        depth[self.window.slices_in(window)] = self.depth_mm
        return depth


def vsd(
    estimate: ObjectDepth,
    truth: ObjectDepth,
    scene_depth_mm: Floats,
    camera: Intrinsics,
    taus_mm: Sequence[float] | Floats,
    delta_mm: float = VISIBILITY_DELTA_MM,
) -> Floats:
    """Visible Surface Discrepancy, one value for each tolerance, 0 to 1.

    Args:
        estimate, truth: the object's depth in the estimated and in the true pose.
        scene_depth_mm: (H, W) the image's depth, 0 where it is missing; there the object counts as visible.
        camera: of the image.
        taus_mm: tolerances of the distance; a pixel costs 1 from there on.
        delta_mm: how far behind the scene's surface the object still counts as visible.
    """
    window = _bounding(estimate.window, truth.window)
    rays = Rays.through(camera, window)
    scene = scene_depth_mm[window.slices_in(image_window(camera))]
    of_scene, of_estimate, of_truth = (_distance(d, rays) for d in (scene, estimate.over(window), truth.over(window)))
    seen_truth = _visible(of_truth, of_scene, delta_mm)
    seen_estimate = _visible(of_estimate, of_scene, delta_mm) | (seen_truth & (of_estimate > 0))
    both = seen_truth & seen_estimate
    union = int(np.count_nonzero(seen_truth | seen_estimate))
    if union == 0:
        return np.ones(len(taus_mm))
    differences = np.abs(of_truth[both] - of_estimate[both])
    costs = np.array([np.count_nonzero(differences >= tau) for tau in taus_mm])
    return np.asarray((costs + union - len(differences)) / union)


def silhouettes_may_overlap(radius_mm: float, estimate: ArrayLike, truth: ArrayLike) -> bool:
    """bop_toolkit's quick test, with spheres around the models' origins; VSD is 1 where it fails."""
    (x1, y1, z1), (x2, y2, z2) = np.asarray(estimate, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if z1 == 0 or z2 == 0:
        return False
    return bool(np.hypot(x1 / z1 - x2 / z2, y1 / z1 - y2 / z2) < radius_mm * (1 / z1 + 1 / z2))


def _distance(depth_mm: Floats, rays: Rays) -> Floats:
    """Distance from the camera along each ray."""
    return np.asarray(np.sqrt((rays.x * depth_mm) ** 2 + (rays.y * depth_mm) ** 2 + depth_mm**2))


def _visible(distance: Floats, of_scene: Floats, delta_mm: float) -> NDArray[np.bool_]:
    """bop_toolkit's visibility mask `bop19`, which compares in single precision."""
    behind = distance.astype(np.float32) - of_scene.astype(np.float32)
    return np.asarray(((behind <= delta_mm) | (of_scene == 0)) & (distance > 0))


def _bounding(a: Window, b: Window) -> Window:
    """The smallest window around two, of which an empty one counts for nothing."""
    windows = [window for window in (a, b) if 0 not in window.shape] or [a]
    return Window(
        min(w.left for w in windows),
        min(w.top for w in windows),
        max(w.right for w in windows),
        max(w.bottom for w in windows),
    )
