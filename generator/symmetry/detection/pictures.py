"""Pictures of parts: coloured by how far a group's elements move the surface, with the group's axes.

`obj_%06d.png` for each object of a folder or table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from synthetless.annotation.instances import PosedModel
from synthetless.annotation.raycast import RayCaster
from synthetless.errors import UserError
from synthetless.extras import cv2
from synthetless.io.cad import TESSELLATION_MM
from synthetless.io.files import atomic_write
from synthetless.io.images import encode_png
from synthetless.io.meshes import TriangleMesh, read_mesh
from synthetless.io.models import find_meshes
from synthetless.io.parallel import each
from synthetless.scenes.spec import Intrinsics
from synthetless.symmetry.ambiguity import Cosets, see
from synthetless.symmetry.canonical import CanonicalMap
from synthetless.symmetry.detection.detect import measure
from synthetless.symmetry.detection.distance import PIECE, Surface
from synthetless.symmetry.detection.folder import DetectedFolder
from synthetless.symmetry.detection.report import group_cells
from synthetless.symmetry.detection.residual import GroupFit, directions, moved, spread_elements
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.quaternions import Floats, normalise
from synthetless.symmetry.table import SymmetryEntry, SymmetryTable

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

_TILE_PX, _HEAD_PX, _LEGEND_PX = 400, 34, 120
_MARGIN_PX = 24
_VIEWS, _SEEN_PX, _MAP_PX = 200, 100, 240
_DISTANCE = 6.0  # of the camera, in diameters
_DIRECTIONS = ((1.0, -1.4, 0.8), (-1.0, 0.9, -0.7), (0.25, -0.3, 1.0))  # from the part to the camera, z up
_SAMPLES, _IMAGES = 8000, 16
_NEIGHBOURS = 3
_INK, _GREY = (40, 40, 40), (190, 190, 190)
_AXIS_COLOURS = {2: (30, 90, 220), 3: (20, 150, 60), 4: (200, 40, 160), 5: (220, 120, 0)}
_MAIN_AXIS = (210, 20, 20)
_DASHES = 120
_TOLERANCE_PERCENT = 1.0  # of the diameter: the scale of a table's picture does not end below it


def draw_detected(detected: DetectedFolder, to: Path, workers: int | None = None) -> None:
    """Draw every object with its group and, below, its quasi-symmetry group or else the next larger one.

    Args:
        detected: what `detect_folder` found.
        to: folder of the pictures; made if it is missing.
        workers: processes; one per available core if None.

    Raises:
        UserError: a mesh cannot be read any more, or a picture not be written.
    """
    tasks = [
        _Task(
            path=o.path,
            scale=detected.scale,
            tessellation_mm=detected.tessellation_mm,
            target=to / f"obj_{o.obj_id:06d}.png",
            title=f"object {o.obj_id}",
            tolerance_percent=100 * o.detected.tolerance_mm / o.detected.diameter_mm,
            shown=tuple(f for f in (o.detected.answer, o.quasi or o.detected.next_larger) if f is not None),
            has_quasi=o.quasi is not None,
        )
        for o in detected.objects
    ]
    _draw_all(tasks, workers)


def draw_table(table: SymmetryTable, models: Path, to: Path, workers: int | None = None) -> None:
    """Draw the objects of a symmetry table whose meshes a folder holds; arguments and errors as in `draw_detected`.

    A quasi-symmetry group is drawn below the exact one: where the surface is coloured is the detail between them. Below
    that is the viewing sphere, by how much of the group a view leaves open.

    Raises:
        UserError: the folder holds none of the table's objects.
    """
    paths = {obj_id: path for obj_id, path in find_meshes(models).paths.items() if obj_id in table.entries}
    if not paths:
        raise UserError(f"{models}: holds none of the table's objects, {', '.join(map(str, table.entries))}")
    tasks = [
        _Task(
            path,
            1.0,
            to / f"obj_{obj_id:06d}.png",
            f"object {obj_id}",
            _TOLERANCE_PERCENT,
            _groups_of(table.entries[obj_id]),
            has_quasi=table.entries[obj_id].quasi is not None,
        )
        for obj_id, path in paths.items()
    ]
    _draw_all(tasks, workers)


def _groups_of(entry: SymmetryEntry) -> tuple[SymmetryGroup, ...]:
    return (entry.group,) if entry.quasi is None else (entry.group, entry.quasi.group)


@dataclass(frozen=True)
class _Task:
    path: Path
    scale: float
    target: Path
    title: str
    tolerance_percent: float
    shown: tuple[GroupFit | SymmetryGroup, ...]
    tessellation_mm: float = TESSELLATION_MM
    has_quasi: bool = False


def _draw_all(tasks: list[_Task], workers: int | None) -> None:
    for _ in each(_draw, tasks, workers, "pictures", "mesh"):
        pass


def _draw(task: _Task) -> None:
    mesh = read_mesh(task.path, task.scale, tessellation_mm=task.tessellation_mm)
    tolerance_mm = task.tolerance_percent / 100 * mesh.diameter_mm
    fits = [
        shown if isinstance(shown, GroupFit) else measure(mesh.vertices_mm, mesh.faces, mesh.diameter_mm, shown)
        for shown in task.shown
    ]
    drawn = picture(task.title, mesh, fits, tolerance_mm)
    if task.has_quasi and fits[-1].group.family != "SO(3)":
        drawn = np.concatenate([drawn, views_left_open(mesh, fits[0].group, fits[-1].group, drawn.shape[1])])
    write_picture(task.target, drawn)


def picture(title: str, mesh: TriangleMesh, fits: Sequence[GroupFit], tolerance_mm: float) -> Image:
    """One row of views per fit: (H, W, 3) RGB.

    The colour of a surface point is its largest deviation over (at most 16, evenly chosen) elements of the group; a
    ring marks the point that deviates most, be it visible or not.
    """
    views = _Views(mesh)
    rows = [views.row(fit, f"{title}   " if i == 0 else "", tolerance_mm) for i, fit in enumerate(fits)]
    return np.concatenate(rows)


def views_left_open(mesh: TriangleMesh, exact: SymmetryGroup, quasi: SymmetryGroup, width_px: int) -> Image:
    """The viewing sphere by which share of the cosets beside the true one a view leaves open, the object being
    _SEEN_PX pixels large: (H, width_px, 3) RGB. An equal-area map (Hammer's), z up, x in the middle.

    Raises:
        UserError: the quasi-symmetry group is SO(3).
    """
    caster, center = RayCaster({("model", 0): (mesh.vertices_mm, mesh.faces)}), mesh.vertices_mm.mean(axis=0)
    cosets, canonical_map = Cosets.of(quasi, exact), CanonicalMap(quasi)
    seen_from = directions(_VIEWS)
    shares = []
    for direction in seen_from:
        camera = _camera(mesh, -direction, center, _SEEN_PX, 2)
        posed = PosedModel(0, camera.R, camera.t)
        canonical = canonical_map(camera.R[None], camera.t[None])
        seen = see(caster, camera.pinhole, posed, canonical.R_m2c[0], cosets)
        shares.append((len(seen.alike) - 1) / (len(cosets) - 1))
    image = np.full((_HEAD_PX + _MAP_PX + 2 * _MARGIN_PX, width_px, 3), 255, np.uint8)
    inside, towards = _hammer(_MAP_PX)
    _, nearest = cKDTree(seen_from).query(towards[inside])
    area = image[_HEAD_PX + _MARGIN_PX :, _MARGIN_PX:][:_MAP_PX, : 2 * _MAP_PX]
    area[inside] = _colours(np.array(shares)[nearest])
    text = f"how many of the {len(cosets)} cosets of {exact.name} in {quasi.name} a view leaves open"
    _write(image, f"{text}   z up, x in the middle   object {_SEEN_PX} pixels large", (10, 23))
    left, top, height = 2 * _MAP_PX + 3 * _MARGIN_PX, _HEAD_PX + _MARGIN_PX, _MAP_PX
    image[top : top + height, left : left + 20] = _colours(np.linspace(1, 0, height))[:, None]
    cv2.rectangle(image, (left, top), (left + 19, top + height), _GREY, 1)
    for share, word in ((1.0, "all"), (0.0, "the true one alone: the detail is visible")):
        _write(image, word, (left + 32, round(top + (1 - share) * height) + 4))
    return image


def _hammer(height_px: int) -> tuple[NDArray[np.bool_], Floats]:
    """Which pixels of a map (height_px, 2 height_px) are on it, and unit vectors (h, w, 3) of those directions."""
    rows, columns = np.mgrid[:height_px, : 2 * height_px]
    x = 2 * np.sqrt(2) * ((columns + 0.5) / height_px - 1)
    y = np.sqrt(2) * (1 - 2 * (rows + 0.5) / height_px)
    squared = 1 - (x / 4) ** 2 - (y / 2) ** 2
    z = np.sqrt(squared)
    longitude = 2 * np.arctan2(z * x, 2 * (2 * squared - 1))
    up = np.clip(z * y, -1, 1)
    across = np.sqrt(1 - up**2)
    inside: NDArray[np.bool_] = (x**2 / 8 + y**2 / 2) < 1
    return inside, np.stack([across * np.cos(longitude), across * np.sin(longitude), up], axis=-1)


def write_picture(path: Path, image: Image) -> None:
    """Write a picture as PNG.

    Raises:
        UserError: the file cannot be written.
    """
    atomic_write(path, encode_png(image))


@dataclass(frozen=True)
class _Camera:
    """A view of a part: a pinhole, rotation (3, 3) and translation (3,) mm, model to camera."""

    pinhole: Intrinsics
    R: Floats
    t: Floats

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Pixels (N, 2) and depths (N,) of points (N, 3) of the model frame."""
        seen = points @ self.R.T + self.t
        return self.pinhole.fx * seen[:, :2] / seen[:, 2:] + [self.pinhole.cx, self.pinhole.cy], seen[:, 2]


class _Pen(NamedTuple):
    colour: Colour
    width: int = 1


class _Axis(NamedTuple):
    direction: Floats
    text: str
    pen: _Pen


class _Views:
    def __init__(self, mesh: TriangleMesh) -> None:
        low, high = mesh.vertices_mm.min(axis=0), mesh.vertices_mm.max(axis=0)
        self._center, self._diameter = (low + high) / 2, mesh.diameter_mm
        self._cameras = [_camera(mesh, -normalise(d), self._center) for d in _DIRECTIONS]
        self._surface = Surface(mesh.vertices_mm, mesh.faces, PIECE * mesh.diameter_mm)
        self._samples = self._surface.sampled(_SAMPLES)
        self._tree = cKDTree(self._samples)
        caster = RayCaster({("model", 0): (mesh.vertices_mm, mesh.faces)})
        self._seen = [
            caster.annotate(c.pinhole, None, [PosedModel(0, c.R, c.t)], normals=True, object_coordinates=True)
            for c in self._cameras
        ]

    def row(self, fit: GroupFit, title: str, tolerance_mm: float) -> Image:
        deviations = self._deviations(fit.group)
        top = max(fit.residual.max_mm, tolerance_mm)
        axes = _axes_of(fit.group)
        tiles = [self._tile(i, deviations / top, fit, axes) for i in range(len(self._cameras))]
        body = np.concatenate([*tiles, _legend(top, tolerance_mm, axes)], axis=1)
        head = np.full((_HEAD_PX, body.shape[1], 3), 255, np.uint8)
        name, axis, offset = group_cells(fit.group)
        place = "" if name == "C1" else f"   axis {axis}   fixed point {offset}"
        share = 100 * fit.residual.max_mm / self._diameter
        _write(head, f"{title}{name}{place}   largest residual {fit.residual.max_mm:.3f} mm ({share:.2f} %)", (10, 23))
        return np.concatenate([head, body])

    def _deviations(self, group: SymmetryGroup) -> Floats:
        """The largest deviation of each sample (N,), mm."""
        if group.name == "C1":
            return np.zeros(len(self._samples))
        elements = spread_elements(group, _IMAGES)
        found = [
            self._surface.distance(moved(group, self._samples, np.tile(element, (len(self._samples), 1))))
            for element in np.unique(elements, axis=0)
        ]
        return np.asarray(np.max(found, axis=0))

    def _tile(self, i: int, shares: Floats, fit: GroupFit, axes: Sequence[_Axis]) -> Image:
        camera, seen = self._cameras[i], self._seen[i]
        image = np.full((_TILE_PX, _TILE_PX, 3), 255, np.uint8)
        on_part = seen.instance_ids >= 0
        assert seen.object_coordinates_mm is not None and seen.normals is not None
        _, nearest = self._tree.query(seen.object_coordinates_mm[on_part], k=_NEIGHBOURS)
        colours = _colours(shares[nearest].mean(axis=1))
        shading = 0.45 + 0.55 * np.clip(seen.normals[on_part] @ normalise([-0.4, -0.6, -1.0]), 0, 1)
        image[on_part] = np.clip(colours * shading[:, None], 0, 255)
        depth = np.where(on_part, seen.depth_mm, np.inf)
        for axis in reversed(axes):
            self._draw_axis(image, camera, depth, np.array(fit.group.offset_mm), axis)
        if fit.residual.worst_mm is not None:
            _mark(image, camera, np.array(fit.residual.worst_mm))
        _draw_frame(image, camera.R)
        return image

    def _draw_axis(self, image: Image, camera: _Camera, depth: Floats, through: Floats, axis: _Axis) -> None:
        """A line through the part: whole in front of it, dashed behind its surface."""
        u = axis.direction
        middle = through + u * float((self._center - through) @ u)
        points = middle + np.linspace(-0.62, 0.62, _DASHES)[:, None] * self._diameter * u
        pixels, depths = camera.project(points)
        columns, rows = np.clip(np.rint(pixels).astype(int), 0, _TILE_PX - 1).T
        drawn = (depths <= depth[rows, columns]) | (np.arange(_DASHES) % 6 < 3)
        ends = np.flatnonzero(np.diff(np.concatenate([[False], drawn, [False]])))
        for first, last in zip(ends[::2], ends[1::2] - 1, strict=True):
            _line(image, pixels[first], pixels[last], axis.pen)


def _camera(
    mesh: TriangleMesh, forward: Floats, center: Floats, side_px: int = _TILE_PX, margin_px: int = _MARGIN_PX
) -> _Camera:
    """A camera that looks along `forward`, z up, and sees the whole part in the middle of a square image."""
    right = normalise(np.cross(forward, [0.0, 0.0, 1.0]))
    R = np.stack([right, np.cross(forward, right), forward])
    t = np.array([0, 0, _DISTANCE * mesh.diameter_mm]) - R @ center
    seen = mesh.vertices_mm @ R.T + t
    flat = seen[:, :2] / seen[:, 2:]
    low, high = flat.min(axis=0), flat.max(axis=0)
    focal = (side_px - 2 * margin_px) / float((high - low).max())
    cx, cy = side_px / 2 - focal * (low + high) / 2
    return _Camera(Intrinsics(side_px, side_px, focal, focal, float(cx), float(cy)), R, t)


def _axes_of(group: SymmetryGroup) -> list[_Axis]:
    """The axes of a group, the main one first; only that of a continuous group."""
    if group.axis is None:
        return []
    main = np.array(group.axis)
    if not group.is_finite:
        return [_Axis(main, "axis", _Pen(_MAIN_AXIS, 2))]
    directions: list[Floats] = [main]
    counts = [1]
    for axis in normalise(group.elements_wxyz[1:, 1:]):
        parallel = np.abs(np.stack(directions) @ axis) > 0.999
        if parallel.any():
            counts[int(np.argmax(parallel))] += 1
        else:
            directions.append(axis)
            counts.append(2)
    others = [_Axis(d, f"{n}-fold", _Pen(_AXIS_COLOURS[n])) for d, n in zip(directions[1:], counts[1:], strict=True)]
    return [_Axis(main, f"{counts[0]}-fold, main", _Pen(_MAIN_AXIS, 2)), *others]


def _colours(shares: Floats) -> Floats:
    """Pale grey for 0, then yellow to red for 1: (N, 3) RGB, 0 to 255."""
    stops = np.array([[205, 208, 212], [255, 214, 90], [246, 120, 40], [190, 10, 40]], dtype=np.float64)
    places = np.linspace(0, 1, len(stops))
    return np.stack([np.interp(shares, places, stops[:, k]) for k in range(3)], axis=1)


def _legend(top_mm: float, tolerance_mm: float, axes: Sequence[_Axis]) -> Image:
    """The colour scale in mm, with a mark at the tolerance, and what the axes' colours mean."""
    image = np.full((_TILE_PX, _LEGEND_PX, 3), 255, np.uint8)
    high, low = 40, 250
    image[high:low, 12:32] = _colours(np.linspace(1, 0, low - high))[:, None]
    cv2.rectangle(image, (12, high), (31, low), _GREY, 1)
    for share in (0.0, 0.5, 1.0):
        _write(image, f"{share * top_mm:.3g}", (44, round(low - share * (low - high)) + 4))
    _write(image, "mm", (12, high - 12))
    y = round(low - min(tolerance_mm / top_mm, 1) * (low - high))
    cv2.line(image, (6, y), (37, y), _INK, 1)
    _write(image, "- tolerance", (12, low + 24))
    cv2.circle(image, (16, low + 38), 5, _INK, 1, cv2.LINE_AA)
    _write(image, "largest", (28, low + 42))
    entries = {pen.colour: text for _, text, pen in axes}
    for line, (colour, text) in enumerate(entries.items()):
        _write(image, text, (12, low + 72 + 18 * line), colour)
    return image


def _mark(image: Image, camera: _Camera, point: Floats) -> None:
    """A ring around a point, which may lie behind what is seen."""
    x, y = np.rint(camera.project(point[None])[0][0]).astype(int).tolist()
    cv2.circle(image, (x, y), 9, _INK, 1, cv2.LINE_AA)


def _draw_frame(image: Image, R: Floats) -> None:
    """The model frame's axes in the corner."""
    origin = np.array([38.0, _TILE_PX - 38.0])
    for axis, name, colour in zip(R.T, "xyz", ((200, 40, 40), (30, 140, 40), (40, 70, 210)), strict=True):
        tip = origin + 24 * axis[:2]
        _line(image, origin, tip, _Pen(colour))
        _write(image, name, tuple(np.rint(origin + 32 * axis[:2] + [-3, 4]).astype(int).tolist()), colour)


def _line(image: Image, a: Floats, b: Floats, pen: _Pen) -> None:
    (ax, ay), (bx, by) = np.rint(16 * np.stack([a, b])).astype(int).tolist()  # OpenCV's fixed point
    cv2.line(image, (ax, ay), (bx, by), pen.colour, pen.width, cv2.LINE_AA, shift=4)


def _write(image: Image, text: str, at: tuple[int, ...], colour: Colour = _INK) -> None:
    cv2.putText(image, text, (at[0], at[1]), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
