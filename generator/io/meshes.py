"""Mesh files: PLY, STL, OBJ, OFF and GLB, and CAD files, read as triangles; the only mesh reader of the project.

Libraries were tried first. trimesh (5.2) cuts concave polygons into overlapping triangles and refuses polygons of
several sizes in one PLY file, spare bytes and Latin-1 comments; meshio (5.3) fails on these, too, and on a list called
vertex_index. They take three and six times as long for the text of the T-LESS models. Polygons are cut by Manifold's
triangulator, which keeps every corner, also those on a straight edge. GLB files, which have triangles only, are read
by trimesh.
"""

from __future__ import annotations

import io
import re
import stat
import struct
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.extras import need
from synthetless.io.cad import CAD_SUFFIXES, TESSELLATION_MM, read_cad
from synthetless.io.paint import Paint, PaintFault, linear_factor, one_texture, read_mtl, read_picture
from synthetless.scenes.spec import SurfaceColours

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_FLAT = 1e-6
"""A mesh is flat if it is thinner than this share of its extent."""
_SLIVER = 1e-6
"""A polygon is cut another way rather than into a triangle of less than this share of its area."""
_LARGEST = 1e30
"""A coordinate beyond it is none of a part, and its square would leave the range of numbers."""
_MOST_CORNERS = 10_000
"""Of a concave polygon; checking it takes the square of its corners."""
_BLOCK = 1024


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangle mesh.

    Attributes:
        vertices_mm: (V, 3) the vertices that faces use, in the file's order.
        faces: (F, 3) vertex numbers, counterclockwise seen from outside; polygons are cut in their place.
        is_verbatim: whether the file is a PLY file that holds exactly these vertices and triangles, so that a copy of
            it is this mesh for every other reader.
        colours: of its surface, if they were asked for and the file has any.
        texture_file: the name by which a PLY file calls its texture.
    """

    vertices_mm: Floats
    faces: Ints
    is_verbatim: bool
    colours: SurfaceColours | None = None
    texture_file: str | None = None

    @cached_property
    def is_flat(self) -> bool:
        """Whether all vertices lie in one plane."""
        extents = _principal_extents(self.vertices_mm)
        return not extents[-1] > _FLAT * extents[0]

    @cached_property
    def diameter_mm(self) -> float:
        """The largest distance between two vertices."""
        return diameter(self.vertices_mm)

    def bop_info(self) -> dict[str, float]:
        """BOP's diameter, min_ and size_ of `models_info.json`, mm."""
        low, size = self.vertices_mm.min(axis=0), np.ptp(self.vertices_mm, axis=0)
        entry = {"diameter": self.diameter_mm}
        entry |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
        return entry | {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}

    def to_ply(self, texture_file: str = "") -> bytes:
        """A binary PLY file; coordinates are floats where that loses nothing, else doubles.

        Colours are written as BOP has them: of vertices, or texture coordinates and the name of the texture's file.
        """
        exact = bool((self.vertices_mm.astype(np.float32) == self.vertices_mm).all())
        kind, code = ("float", "<f4") if exact else ("double", "<f8")
        colours = self.colours or SurfaceColours()
        named = f"comment TextureFile {texture_file}\n" if colours.texture is not None else ""
        rgb = "".join(f"property uchar {name}\n" for name in _RGB) if colours.vertex_rgb is not None else ""
        uv = "property list uchar float texcoord\n" if colours.corner_uv is not None else ""
        header = (
            f"ply\nformat binary_little_endian 1.0\n{named}element vertex {len(self.vertices_mm)}\n"
            f"property {kind} x\nproperty {kind} y\nproperty {kind} z\n{rgb}"
            f"element face {len(self.faces)}\nproperty list uchar int vertex_indices\n{uv}end_header\n"
        )
        vertices = np.empty(len(self.vertices_mm), [("xyz", code, (3,)), *([("rgb", "u1", (3,))] if rgb else [])])
        vertices["xyz"] = self.vertices_mm
        if colours.vertex_rgb is not None:
            vertices["rgb"] = colours.vertex_rgb
        places = [("uv_count", "u1"), ("uv", "<f4", (6,))] if uv else []
        rows = np.empty(len(self.faces), [("count", "u1"), ("corners", "<i4", (3,)), *places])
        rows["count"], rows["corners"] = 3, self.faces
        if colours.corner_uv is not None:
            rows["uv_count"], rows["uv"] = 6, colours.corner_uv.reshape(-1, 6)
        return header.encode() + vertices.tobytes() + rows.tobytes()


def diameter(points: Floats) -> float:
    """The largest distance between two of the (N, 3) points, in their unit; it is one between corners of their hull."""
    from scipy.spatial import ConvexHull, QhullError
    from scipy.spatial.distance import cdist

    centred = points - points.mean(axis=0)
    extents = _principal_extents(points)
    rank = int((extents > _FLAT * extents[0]).sum())
    if rank == 3:
        try:
            ends = points[ConvexHull(points).vertices]
        except QhullError:
            ends = points[ConvexHull(points, qhull_options="QJ").vertices]
    else:
        along = centred @ np.linalg.svd(centred, full_matrices=False)[2][: max(rank, 1)].T
        ends = points[ConvexHull(along).vertices if rank == 2 else [along.argmin(), along.argmax()]]
    return max(float(cdist(ends[i : i + _BLOCK], ends).max()) for i in range(0, len(ends), _BLOCK))


def _principal_extents(points: Floats) -> Floats:
    extents = np.linalg.svd(points - points.mean(axis=0), full_matrices=False, compute_uv=False)
    return np.pad(extents, (0, 3 - len(extents)))  # fewer than three points span as few directions


def read_mesh(
    path: Path, scale: float = 1.0, colours: bool = False, tessellation_mm: float = TESSELLATION_MM
) -> TriangleMesh:
    """Read a PLY, STL, OBJ, OFF, GLB, STEP or IGES file, told by the end of its name.

    Polygons may be concave and a little warped, and of any number of corners; they are cut into triangles that cover
    them exactly. Vertices that no face uses are dropped.

    Args:
        path: of the file.
        scale: what its coordinates are multiplied by to give millimetres; those of CAD files, which state their unit,
            are millimetres before.
        colours: whether to read the colours of its surface, too: those of vertices (PLY, OBJ, GLB), or its materials'
            colours and textures (OBJ, GLB; one texture of PLY files, as BOP has it).
        tessellation_mm: how far the triangles of a CAD file may be from its surface.

    Raises:
        UserError: it cannot be read, is damaged, has no faces, a coordinate that is not finite, or a polygon that
            crosses itself; a file of materials or a texture that it names is missing or cannot be decoded. The message
            names the file, what is wrong with it, and the line or the face.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None and path.suffix.lower() in CAD_SUFFIXES:
        reader = partial(_read_cad, path.suffix, tessellation_mm)
    if reader is None:
        raise UserError(f"{path}: not a mesh file; one that ends in {', '.join(SUFFIXES)} is needed")
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise UserError(f"{path}: not a file")
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused by name
            return _mesh_of(reader(data, path.parent if colours else None), scale)
    except (_Fault, PaintFault) as fault:
        raise UserError(f"{path}: {fault}") from None


def _read_cad(suffix: str, tolerance_mm: float, data: bytes, _: Path | None) -> _Polygons:
    try:
        vertices, faces = read_cad(data, suffix, tolerance_mm)
    except UserError as error:
        raise _Fault(str(error)) from None
    return _Polygons(vertices, faces.ravel(), np.full(len(faces), 3))


class _Fault(Exception):
    """What is wrong with a file, in one line without its name."""


@dataclass(frozen=True, eq=False)
class _Polygons:
    """What a file holds.

    Attributes:
        vertices: (V, 3).
        corners: (C,) vertex numbers, polygon after polygon.
        sizes: (P,) how many corners each polygon has.
        is_plain: whether any reader of PLY files understands the file.
        rgb: (V, 3) colours of the vertices, 0..1, displayed.
        uv: (C, 2) places of the corners in their polygon's picture, NaN where they have none.
        paints: that polygons have.
        paint_of: (P,) number of the paint of each polygon.
        texture_file: the name by which a PLY file calls its texture.
    """

    vertices: Floats
    corners: Ints
    sizes: Ints
    is_plain: bool = False
    rgb: Floats | None = None
    uv: Floats | None = None
    paints: Sequence[Paint] = ()
    paint_of: Ints | None = None
    texture_file: str | None = None


def _mesh_of(polygons: _Polygons, scale: float) -> TriangleMesh:
    vertices, corners = polygons.vertices, polygons.corners
    if len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices):
        wrong = int(np.flatnonzero((corners < 0) | (corners >= len(vertices)))[0])
        face = int(np.searchsorted(np.cumsum(polygons.sizes), wrong, side="right"))
        raise _Fault(f"face {face} names vertex {corners[wrong]}, but there are only {len(vertices)}, counted from 0")
    used = np.zeros(len(vertices), dtype=bool)
    used[corners] = True
    bad = np.flatnonzero(used & ~(np.abs(vertices) < _LARGEST).all(axis=1))
    if len(bad):
        raise _Fault(f"vertex {bad[0]} is {vertices[bad[0]].tolist()}; every coordinate must be finite")
    numbered = _triangulate(vertices[corners], np.arange(len(corners)), polygons.sizes)
    if len(numbered) == 0:
        raise _Fault("holds no faces; a triangle mesh is needed")
    faces = corners[numbered]
    used[:] = False
    used[faces] = True
    colours = _colours_of(polygons, numbered, used)
    if not used.all():
        vertices, faces = vertices[used], (np.cumsum(used) - 1)[faces]
    is_verbatim = polygons.is_plain and scale == 1 and bool(used.all() and (polygons.sizes == 3).all())
    scaled = np.ascontiguousarray(vertices * scale)
    return TriangleMesh(scaled, faces, is_verbatim, colours, polygons.texture_file)


def _colours_of(polygons: _Polygons, triangles: Ints, used: NDArray[np.bool_]) -> SurfaceColours | None:
    """The colours of triangles (F, 3) of corners: a texture, or else vertex colours, or else flat colours."""
    has_picture = any(paint.picture is not None for paint in polygons.paints)
    if polygons.rgb is not None and not has_picture:
        return SurfaceColours(vertex_rgb=np.rint(255 * np.clip(polygons.rgb[used], 0, 1)).astype(np.uint8))
    if polygons.paint_of is None:
        return None
    owner = np.repeat(np.arange(len(polygons.sizes)), polygons.sizes)[triangles[:, 0]]
    uv = np.full((len(polygons.corners), 2), np.nan) if polygons.uv is None else polygons.uv
    corner_uv = uv[triangles].astype(np.float32)
    texture, corner_uv = one_texture(polygons.paints, polygons.paint_of[owner], corner_uv)
    return SurfaceColours(texture=texture, corner_uv=corner_uv)


# Polygons


def _triangulate(vertices: Floats, corners: Ints, sizes: Ints) -> Ints:
    """(F, 3) triangles that cover the polygons, in their order; what has fewer than three corners covers nothing."""
    if (sizes == 3).all():
        return corners.reshape(-1, 3)
    starts = np.cumsum(sizes) - sizes
    owners, triangles = [np.empty(0, np.int64)], [np.empty((0, 3), np.int64)]
    for size in np.unique(sizes[sizes >= 3]):
        polygons = np.flatnonzero(sizes == size)
        rings = corners[starts[polygons, None] + np.arange(size)]
        for first in range(2 if size > 3 else 1):
            rings = np.roll(rings, -first, axis=1)
            fits = _fan_covers(vertices[rings]) if size > 3 else np.ones(len(rings), dtype=bool)
            fan = np.stack([np.broadcast_to(rings[:, :1], rings[:, 2:].shape), rings[:, 1:-1], rings[:, 2:]], axis=2)
            owners.append(np.repeat(polygons[fits], size - 2))
            triangles.append(fan[fits].reshape(-1, 3))
            polygons, rings = polygons[~fits], rings[~fits]
        for polygon, ring in zip(polygons, rings, strict=True):
            cut = ring[_cut(vertices[ring], int(polygon))]
            owners.append(np.full(len(cut), polygon))
            triangles.append(cut)
    order = np.argsort(np.concatenate(owners), kind="stable")
    return np.concatenate(triangles)[order]


def _fan_covers(points: Floats) -> NDArray[np.bool_]:
    """(P,) whether triangles from the first corner to the others cover each of the polygons (P, N, 3), without overlap.

    They do if all face the same way and turn by less than a whole turn round that corner.
    """
    rays = points[:, 1:] - points[:, :1]
    crosses = np.cross(rays[:, :-1], rays[:, 1:])
    normals = crosses.sum(axis=1)
    areas = np.linalg.norm(normals, axis=1)
    along = (crosses * normals[:, None]).sum(axis=2)
    turns = np.arctan2(np.linalg.norm(crosses, axis=2), (rays[:, :-1] * rays[:, 1:]).sum(axis=2)).sum(axis=1)
    return np.asarray((along > _SLIVER * (areas**2)[:, None]).all(axis=1) & (turns < 2 * np.pi))


def _cut(points: Floats, polygon: int) -> Ints:
    """(T, 3) triangles, as numbers of corners, that cover a polygon (N, 3) of any form."""
    from manifold3d import triangulate

    if len(points) > _MOST_CORNERS:
        raise _Fault(f"face {polygon} has {len(points)} corners; triangulate the mesh in the program that it is from")
    distinct = np.flatnonzero((points != np.roll(points, 1, axis=0)).any(axis=1))
    ring = points[distinct]
    if len(ring) < 3:
        return np.empty((0, 3), np.int64)
    rays = ring - ring[0]
    normal = np.cross(rays[:-1], rays[1:]).sum(axis=0)
    extents = np.linalg.svd(rays, compute_uv=False)
    if extents[1] <= _SLIVER * extents[0]:  # a line: whatever covers it
        return np.column_stack([np.full(len(ring) - 2, distinct[0]), distinct[1:-1], distinct[2:]])
    axis = int(np.abs(normal).argmax())
    flat = np.delete(rays, axis, axis=1)[:, :: 1 if (normal[axis] > 0) == (axis != 1) else -1]
    triangles = np.asarray(triangulate([np.ascontiguousarray(flat)]), dtype=np.int64).reshape(-1, 3)
    if not _covers_once(flat, triangles):
        raise _Fault(f"face {polygon} crosses itself; triangulate the mesh in the program that it is from")
    return np.asarray(distinct[triangles])


def _covers_once(ring: Floats, triangles: Ints) -> bool:
    """Whether triangles of a plane polygon (N, 2) face up and lie inside it, where it winds just once."""
    a, b, c = (ring[triangles[:, i]] for i in range(3))
    areas = _cross2(b - a, c - a) / 2
    whole = _cross2(ring, np.roll(ring, -1, axis=0)).sum() / 2
    if not (whole > 0 and (areas > -_SLIVER * whole).all()):
        return False
    centres = ((a + b + c) / 3)[areas > _SLIVER * whole]
    return all(_winds_once(ring, centres[i : i + _BLOCK]) for i in range(0, len(centres), _BLOCK))


def _winds_once(ring: Floats, points: Floats) -> bool:
    before, after = ring[None] - points[:, None], np.roll(ring, -1, axis=0)[None] - points[:, None]
    turns = np.arctan2(_cross2(before, after), (before * after).sum(axis=2)).sum(axis=1)
    return bool((np.abs(turns / (2 * np.pi) - 1) < 0.5).all())


def _cross2(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


# PLY

_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_FACE_LISTS = ("vertex_indices", "vertex_index")
_RGB = ("red", "green", "blue")
_UV = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_FULL_SCALE = {"u1": 255.0, "u2": 65535.0}


@dataclass(frozen=True)
class _Property:
    """A property of a PLY element; a list if its length has a type."""

    name: str
    type: str
    length_type: str | None = None


@dataclass(frozen=True)
class _Element:
    """What the header of a PLY file says of an element."""

    name: str
    count: int
    properties: tuple[_Property, ...]

    def column(self, *names: str) -> int:
        """The place of the property of one of these names, -1 if there is none."""
        return next((i for i, p in enumerate(self.properties) if p.name in names), -1)

    def cut_off(self, row: int) -> _Fault:
        return _Fault(f"cut off after {row} of {self.count} rows of {self.name}")


def _read_ply(data: bytes, folder: Path | None) -> _Polygons:
    header, order, elements = _ply_header(data)
    body = _AsciiBody(data, header) if order == "" else _BinaryBody(data, header, order)
    vertices, corners, sizes = np.empty((0, 3)), np.empty(0), np.empty(0, np.int64)
    rgb: Floats | None = None
    vertex_uv: Floats | None = None
    corner_uv: Floats | None = None
    for element in elements:
        table = body.read(element)
        if element.name == "tristrips":
            raise _Fault("holds triangle strips; save it with faces instead")
        if element.count == 0:
            continue
        if element.name == "vertex":
            columns = [element.column(axis) for axis in "xyz"]
            if -1 in columns or any(element.properties[i].length_type for i in columns):
                raise _Fault("its vertices have no properties x, y and z")
            vertices = np.column_stack([table.values(i) for i in columns])
            rgb = _ply_columns(element, table, _RGB)
            vertex_uv = next((uv for names in _UV if (uv := _ply_columns(element, table, names)) is not None), None)
        elif element.name == "face":
            column = element.column(*_FACE_LISTS)
            if column < 0 or element.properties[column].length_type is None:
                raise _Fault(f"its faces have no list called {' or '.join(_FACE_LISTS)}")
            corners, sizes = table.values(column), table.lengths[column]
            places = element.column("texcoord")
            if places >= 0 and (table.lengths[places] == 2 * sizes).all():
                corner_uv = table.values(places).reshape(-1, 2)
    numbers = corners.astype(np.int64)
    if (numbers != corners).any():
        raise _Fault(f"a face names vertex {corners[numbers != corners][0]:g}; whole numbers are needed")
    polygons = _Polygons(vertices, numbers, sizes, header.isascii() and b"\n" in header and body.is_at_end())
    if folder is None:
        return polygons
    named = re.search(r"(?m)^comment TextureFile[ \t]+(.*\S)", header.decode("latin-1").replace("\r", "\n"))
    if named is None:
        return replace(polygons, rgb=rgb)
    if vertex_uv is not None and corner_uv is None and ((numbers >= 0) & (numbers < len(vertices))).all():
        corner_uv = vertex_uv[numbers]
    paints = (Paint(picture=read_picture(folder, named[1])),)
    return replace(polygons, uv=corner_uv, paints=paints, paint_of=np.zeros_like(sizes), texture_file=named[1])


def _ply_columns(element: _Element, table: _Table, names: Sequence[str]) -> Floats | None:
    """(N, ...) the properties of these names, whole numbers as shares of their largest; None if one is lacking."""
    columns = [element.column(name) for name in names]
    if -1 in columns or any(element.properties[i].length_type for i in columns):
        return None
    return np.column_stack([table.values(i) / _FULL_SCALE.get(element.properties[i].type, 1.0) for i in columns])


def _ply_header(data: bytes) -> tuple[bytes, str, list[_Element]]:
    """The header, the byte order ("" for text), and the elements."""
    opening = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if not opening:
        raise _Fault("is empty" if not data.strip() else "not a PLY file: it does not begin with the line 'ply'")
    newline = opening[1]
    end = re.search(re.escape(newline) + rb"end_header[ \t]*(" + re.escape(newline) + rb"|\Z)", data)
    if not end:
        raise _Fault("cut off in the header: it has no line 'end_header'")
    header = data[: end.end()]
    order: str | None = None
    elements: list[_Element] = []
    for number, line in enumerate(header.decode("latin-1").split(newline.decode()), start=1):
        match line.split():
            case ["format", name, *_] if name in _PLY_ORDERS:
                order = _PLY_ORDERS[name]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,18}", count):
                elements.append(_Element(name, int(count), ()))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= _PLY_TYPES.keys():
                elements[-1] = _with(elements[-1], _Property(name, _PLY_TYPES[kind], _PLY_TYPES[length]))
            case ["property", kind, name] if elements and kind in _PLY_TYPES:
                elements[-1] = _with(elements[-1], _Property(name, _PLY_TYPES[kind]))
            case [] | ["ply" | "end_header" | "comment" | "obj_info", *_]:
                pass
            case _:
                raise _Fault(f"line {number} of the header is not understood: {line[:60]!r}")
    if order is None:
        raise _Fault(f"its header has no format; one of {', '.join(_PLY_ORDERS)} is needed")
    return header, order, elements


def _with(element: _Element, added: _Property) -> _Element:
    return _Element(element.name, element.count, (*element.properties, added))


class _Table:
    """The rows of a PLY element in memory.

    Attributes:
        lengths: for each property (N,) how many values each row has; 1 unless it is a list.
        ends: (N,) where the rows end, in bytes.
    """

    def __init__(
        self, element: _Element, data: bytes | NDArray[np.uint8], starts: Ints, dtype: Callable[[str], np.dtype[Any]]
    ) -> None:
        """Find every value from where the rows start, in bytes; ``dtype`` tells how a type of the header is stored."""
        self._element, self._data = element, data
        self._dtypes = [dtype(p.type) for p in element.properties]
        self._places: list[Ints] = []
        self.lengths: list[Ints] = []
        place = starts
        for p, kind in zip(element.properties, self._dtypes, strict=True):
            lengths = np.ones_like(place)
            if p.length_type:
                inside = np.clip(place, 0, max(len(data) - dtype(p.length_type).itemsize, 0))
                lengths = self._gather(inside, dtype(p.length_type)).astype(np.int64)
                place = place + dtype(p.length_type).itemsize
            self._places.append(place)
            self.lengths.append(lengths)
            place = place + lengths * kind.itemsize
        self.ends = place

    def values(self, column: int) -> Floats:
        """All values of a property, row after row, as its type holds them: a float has 24 bits."""
        places, lengths, dtype = self._places[column], self.lengths[column], self._dtypes[column]
        values: NDArray[Any]
        if _is_even(places) and (lengths == lengths[0]).all():
            shape, steps = (len(places), int(lengths[0])), (int(places[-1] - places[-2]), dtype.itemsize)
            values = np.ndarray(shape, dtype, self._data, int(places[0]), steps).ravel()
        else:
            before = np.cumsum(lengths) - lengths
            within = (np.arange(lengths.sum()) - np.repeat(before, lengths)) * dtype.itemsize
            values = self._gather(np.repeat(places, lengths) + within, dtype)
        if self._element.properties[column].type == "f4":
            values = values.astype(np.float32)
        return values.astype(np.float64)

    def _gather(self, places: Ints, dtype: np.dtype[Any]) -> NDArray[Any]:
        """The values that stand at these places."""
        if _is_even(places):
            return np.ndarray(len(places), dtype, self._data, int(places[0]), (int(places[1] - places[0]),))
        if not (places % dtype.itemsize).any():
            aligned: NDArray[Any] = np.frombuffer(self._data, dtype, len(self._data) // dtype.itemsize)
            return np.asarray(aligned[places // dtype.itemsize])
        codes = np.frombuffer(self._data, np.uint8)[places[:, None] + np.arange(dtype.itemsize)]
        return np.asarray(codes.view(dtype).ravel())


def _is_even(places: Ints) -> bool:
    """Whether there are at least two places, at equal distances."""
    return len(places) > 1 and places[1] > places[0] and bool((np.diff(places) == places[1] - places[0]).all())


class _AsciiBody:
    """Text: a line for each row."""

    def __init__(self, data: bytes, header: bytes) -> None:
        text = data[len(header) :]
        self._text = text if b"\n" in text else text.replace(b"\r", b"\n")
        codes = np.frombuffer(self._text, np.uint8)
        starts = np.concatenate([[0], np.flatnonzero(codes == ord("\n")) + 1]).astype(np.int64)
        starts = starts[starts < len(text)]
        is_space = codes <= ord(" ")
        begins = ~is_space & np.concatenate([[True], is_space[:-1]])
        words = np.add.reduceat(begins, starts, dtype=np.int64) if len(starts) else starts
        filled = np.flatnonzero(words)  # blank lines are passed over
        self._starts, self._ends = starts[filled], np.append(starts[1:], len(text))[filled]
        self._words = words[filled]
        self._numbers = filled + 1 + header.count(b"\n" if b"\n" in header else b"\r")  # of the lines, for messages
        self._row = 0

    def read(self, element: _Element) -> _Table:
        """The next element."""
        first, self._row = self._row, self._row + element.count
        rows = slice(first, self._row)
        words = self._words[rows]
        text = self._text[self._starts[first] : self._ends[rows][-1]] if len(words) else b""
        is_whole = all(p.type[0] in "iu" for p in element.properties)
        numbers = _numbers(text, np.int64) if is_whole else None
        if numbers is None:
            numbers = _numbers(text, np.float64)
        if numbers is None or numbers.size != words.sum():
            raise self._not_a_number(rows)
        table = _Table(element, numbers.view(np.uint8), 8 * (np.cumsum(words) - words), lambda _: numbers.dtype)
        wrong = table.ends != 8 * np.cumsum(words)
        for lengths in table.lengths:
            wrong |= lengths < 0
        if wrong.any():
            row = int(wrong.argmax())
            if first + row == len(self._words) - 1 and table.ends[row] > 8 * words[: row + 1].sum():
                raise element.cut_off(row)
            raise _Fault(
                f"line {self._numbers[first + row]} has {words[row]} values, which is not what the header says of "
                f"{element.name}"
            )
        if len(words) < element.count:
            raise element.cut_off(len(words))
        return table

    def is_at_end(self) -> bool:
        """Whether other readers find nothing more, either: they stop after the last row."""
        return True

    def _not_a_number(self, rows: slice) -> _Fault:
        for start, end, number in zip(self._starts[rows], self._ends[rows], self._numbers[rows], strict=True):
            for word in self._text[start:end].split():
                try:
                    _number(word, f"line {number}")
                except _Fault as fault:
                    return fault
        return _Fault("holds numbers that are not understood")


class _BinaryBody:
    """Numbers as in memory."""

    def __init__(self, data: bytes, header: bytes, order: str) -> None:
        self._data, self._position, self._order = data, len(header), order

    def read(self, element: _Element) -> _Table:
        """The next element."""
        if element.count == 0 or not element.properties:
            return self._table(element, np.empty(0, np.int64))
        first = np.array([self._position])
        size = int(self._table(element, first).ends[0]) - self._position
        room = len(self._data) - self._position
        if not any(p.length_type for p in element.properties) and room < element.count * size:
            raise element.cut_off(room // size)
        if 0 < element.count * size <= room:  # all rows of a size, as in nearly all files?
            starts = self._position + size * np.arange(element.count)
            table = self._table(element, starts)
            if (table.ends - starts == size).all() and all((lengths >= 0).all() for lengths in table.lengths):
                self._position = int(table.ends[-1])
                return table
        table = self._table(element, self._walk(element))
        self._position = int(table.ends[-1])
        return table

    def is_at_end(self) -> bool:
        """Whether nothing follows what was read."""
        return self._position == len(self._data)

    def _dtype(self, kind: str) -> np.dtype[Any]:
        return np.dtype(self._order + kind)

    def _table(self, element: _Element, starts: Ints) -> _Table:
        return _Table(element, self._data, starts, self._dtype)

    def _walk(self, element: _Element) -> Ints:
        """Where each row starts, when their lists differ in length."""
        steps = [
            (struct.Struct((self._order + self._dtype(p.length_type).char) if p.length_type else ""), int(p.type[1]))
            for p in element.properties
        ]
        starts, place = [], self._position
        for row in range(element.count):
            starts.append(place)
            for length_type, width in steps:
                length = 1
                if length_type.size:
                    if place + length_type.size > len(self._data):
                        raise element.cut_off(row)
                    (length,) = length_type.unpack_from(self._data, place)
                if length < 0:
                    raise _Fault(f"row {row} of {element.name} has a list of {length} values")
                place += length_type.size + int(length) * width
            if place > len(self._data):
                raise element.cut_off(row)
        return np.array(starts, dtype=np.int64)


# STL

_STL_TRIANGLE = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER_BYTES = 84


def _read_stl(data: bytes, _: Path | None) -> _Polygons:
    # The number of triangles, below 2^24, ends in a zero byte; texts have none. Both kinds may begin with "solid".
    if len(data) >= _STL_HEADER_BYTES and 0 in data[80:_STL_HEADER_BYTES]:
        vertices = _binary_stl(data)
    elif data.lstrip()[:5].lower() == b"solid":
        vertices = _ascii_stl(data)
    elif not data:
        raise _Fault("is empty")
    elif len(data) < _STL_HEADER_BYTES:
        raise _Fault(f"not an STL file: {len(data)} bytes are fewer than its header has, and it is no text of a solid")
    else:
        vertices = _binary_stl(data)
    count = len(vertices) // 3
    return _Polygons(vertices, np.arange(3 * count), np.full(count, 3))


def _binary_stl(data: bytes) -> Floats:
    declared = int.from_bytes(data[80:_STL_HEADER_BYTES], "little")
    room = (len(data) - _STL_HEADER_BYTES) // _STL_TRIANGLE.itemsize
    if room < declared:
        raise _Fault(f"cut off after {room} of {declared} triangles, or not an STL file")
    if declared == 0 and room:
        raise _Fault(f"its header says that it holds no faces, but {room} triangles follow; save it again")
    table = np.frombuffer(data, _STL_TRIANGLE, declared, _STL_HEADER_BYTES)
    return np.asarray(table["corners"].reshape(-1, 3).astype(np.float64))


def _ascii_stl(data: bytes) -> Floats:
    lines = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = re.sub(rb"(?im)^[ \t]*(end[ \t]*)?solid\b.*$", b"", lines)  # their names may hold any word
    facets = len(re.findall(rb"(?i)\bendfacet\b", text))
    if not re.search(rb"(?im)^[ \t]*end[ \t]*solid\b", lines) or len(re.findall(rb"(?i)\bfacet\b", text)) > facets:
        raise _Fault(f"cut off after {facets} triangles: it does not end with 'endsolid'")
    corners = re.findall(rb"(?i)\bvertex\b([^\n]*?)(?=$|\n|\bvertex\b|\bendloop\b)", text)
    if len(corners) != 3 * facets:
        raise _Fault(f"has {len(corners)} vertices in {facets} facets; three in each are needed")
    numbers = _numbers(b"\n".join(corners), np.float64)
    if numbers is None or numbers.size != 3 * len(corners) or any(len(corner.split()) != 3 for corner in corners):
        raise _stl_fault(text)
    return np.asarray(numbers.reshape(-1, 3))


def _stl_fault(text: bytes) -> _Fault:
    """What is wrong with the first vertex that is not three numbers."""
    for number, line in enumerate(text.split(b"\n"), start=1):
        words = line.split()
        if words and words[0].lower() == b"vertex":
            try:
                _coordinates(words[1:], f"line {number}")
            except _Fault as fault:
                return fault
    return _Fault("has a vertex that is not three numbers")


# OBJ and OFF


def _read_obj(data: bytes, folder: Path | None) -> _Polygons:
    vertices: list[list[float]] = []
    corners: list[int] = []
    sizes: list[int] = []
    lines = re.sub(rb"\\[ \t]*\r?\n", b" ", data).splitlines()
    for number, line in enumerate(lines, start=1):
        words = line.partition(b"#")[0].split()
        if not words:
            continue
        if words[0] == b"v":
            vertices.append(_coordinates(words[1:4], f"line {number}"))
        elif words[0] in {b"f", b"fo"}:
            corners += [_obj_corner(word, len(vertices), f"line {number}") for word in words[1:]]
            sizes.append(len(words) - 1)
        elif words[0] in {b"surf", b"curv2"}:
            raise _Fault(f"line {number} is a free-form surface; save it as polygons")
    polygons = _Polygons(_table(vertices), np.array(corners, dtype=np.int64), np.array(sizes, dtype=np.int64))
    return polygons if folder is None else _with_obj_paint(polygons, lines, folder)


def _with_obj_paint(polygons: _Polygons, lines: Sequence[bytes], folder: Path) -> _Polygons:
    """The polygons of an OBJ file with the colours of its vertices and what its materials look like."""
    rgb: list[list[float]] = []
    places: list[list[float]] = []
    place_of: list[int] = []
    libraries: list[str] = []
    materials: list[str] = [""]
    material_of: list[int] = []
    for number, line in enumerate(lines, start=1):
        words = line.partition(b"#")[0].split()
        match words[:1]:
            case [b"v"] if len(words) in (7, 8):  # perhaps with alpha; a single number more is a weight
                rgb.append(_coordinates(words[4:7], f"line {number}"))
            case [b"vt"]:
                places.append(_coordinates([*words[1:3], b"0", b"0"][:3], f"line {number}")[:2])
            case [b"f" | b"fo"]:
                place_of += [_obj_place(word, len(places)) for word in words[1:]]
                material_of.append(len(materials) - 1)
            case [b"mtllib"]:
                libraries.append(_rest(line))
            case [b"usemtl"]:
                materials.append(_rest(line))
    if len(rgb) == len(polygons.vertices):
        polygons = replace(polygons, rgb=_table(rgb))
    if not libraries or len(materials) == 1:
        return polygons
    known = {name: paint for library in libraries for name, paint in read_mtl(folder, library).items()}
    unknown = [name for name in materials if name and name not in known]
    if unknown:
        raise _Fault(f"uses the material {unknown[0]}, which {', '.join(libraries)} does not define")
    numbers = np.array(place_of, dtype=np.int64)
    if len(numbers) and not -1 <= numbers.min() <= numbers.max() < len(places):
        raise _Fault(f"a face names the texture coordinates {numbers.max() + 1}; there are only {len(places)}")
    uv = np.array([*places, [np.nan, np.nan]], dtype=np.float64)  # the last for corners without any
    paints = [known.get(name, Paint()) for name in materials]
    return replace(polygons, uv=uv[numbers], paints=paints, paint_of=np.array(material_of, dtype=np.int64))


def _rest(line: bytes) -> str:
    """What a line says after its first word."""
    return line.partition(b"#")[0].strip().partition(b" ")[2].strip().decode("utf-8", "replace")


def _obj_place(word: bytes, known: int) -> int:
    """The texture coordinates of a corner `v/vt/vn`, counted from 0; -1 if it has none."""
    text = word.split(b"/")[1] if b"/" in word else b""
    if not re.fullmatch(rb"[+-]?\d{1,18}", text) or int(text) == 0:
        return -1
    return int(text) - 1 if int(text) > 0 else known + int(text)


def _obj_corner(word: bytes, known: int, place: str) -> int:
    """The vertex of a corner `v/vt/vn`; negative numbers count from the last vertex so far."""
    text = word.partition(b"/")[0]
    if not re.fullmatch(rb"[+-]?\d{1,18}", text) or int(text) == 0:
        raise _Fault(f"{place}: {_shown(word)} is not a vertex number; they count from 1")
    return int(text) - 1 if int(text) > 0 else known + int(text)


def _read_off(data: bytes, _: Path | None) -> _Polygons:
    lines = _off_lines(data)
    number, words = next(lines, (0, []))
    kind = re.fullmatch(rb"(ST)?(C)?(N)?(4)?(n)?OFF", words[0]) if words else None
    if not kind:
        raise _Fault("is empty" if not data.strip() else "not an OFF file: it does not begin with 'OFF'")
    if kind[4] or kind[5] or words[1:2] == [b"BINARY"]:
        raise _Fault(f"line {number}: {_shown(b' '.join(words))} is not supported; save it as a plain OFF file")
    counts = words[1:]
    if not counts:
        number, counts = next(lines, (number, []))
    if len(counts) < 2 or not all(re.fullmatch(rb"\d{1,18}", word) for word in counts[:2]):
        raise _Fault(f"line {number}: the numbers of vertices and faces are needed, not {_shown(b' '.join(counts))}")
    vertex_count, face_count = int(counts[0]), int(counts[1])
    vertices: list[list[float]] = []
    for number, words in _first(lines, vertex_count, "vertices"):
        vertices.append(_coordinates(words[:3], f"line {number}"))
    corners: list[int] = []
    sizes: list[int] = []
    for number, words in _first(lines, face_count, "faces"):
        size = int(words[0]) if re.fullmatch(rb"\d{1,9}", words[0]) else len(words)
        numbers = words[1 : 1 + size]
        if len(numbers) < size or not all(re.fullmatch(rb"-?\d{1,18}", word) for word in numbers):
            raise _Fault(f"line {number}: a number of corners and as many vertex numbers are needed")
        corners += map(int, numbers)
        sizes.append(size)
    return _Polygons(_table(vertices), np.array(corners, dtype=np.int64), np.array(sizes, dtype=np.int64))


def _off_lines(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Number and words of the lines that say something."""
    for number, line in enumerate(data.splitlines(), start=1):
        words = line.partition(b"#")[0].split()
        if words:
            yield number, words


def _first(
    lines: Iterator[tuple[int, list[bytes]]], count: int, what: Literal["vertices", "faces"]
) -> Iterator[tuple[int, list[bytes]]]:
    for done in range(count):
        line = next(lines, None)
        if line is None:
            raise _Fault(f"cut off after {done} of {count} {what}")
        yield line


# GLB


def _read_glb(data: bytes, folder: Path | None) -> _Polygons:
    """Every mesh of the scene where it stands; vertices that only normals or textures keep apart are one."""
    import trimesh

    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    except Exception as error:  # trimesh raises whatever its parts do
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise _Fault(f"cannot be read as a GLB file ({reason})") from None
    if not parts:
        raise _Fault("holds no faces; a triangle mesh is needed")
    vertices = np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts])
    before = np.cumsum([0, *(len(part.vertices) for part in parts)])
    corners = np.concatenate(
        [np.asarray(part.faces).ravel() + start for part, start in zip(parts, before, strict=False)]
    )
    polygons = _Polygons(vertices, corners.astype(np.int64), np.full(len(corners) // 3, 3))
    if folder is not None:
        polygons = _with_visuals(polygons, parts)
    keys = vertices if polygons.rgb is None else np.column_stack([vertices, polygons.rgb])
    _, first, same = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    rgb = None if polygons.rgb is None else polygons.rgb[first]
    return replace(polygons, vertices=vertices[first], corners=same.ravel()[corners], rgb=rgb)


def _with_visuals(polygons: _Polygons, parts: Sequence[Any]) -> _Polygons:
    """The polygons with the materials, or the vertex colours, of the parts that they are from."""
    need("PIL")  # without it, trimesh leaves textures out
    visuals = [part.visual for part in parts]
    paints, uv, rgb = [], [], []
    for part, visual in zip(parts, visuals, strict=True):
        material = getattr(visual, "material", None)
        factor = getattr(material, "baseColorFactor", None)
        picture = getattr(material, "baseColorTexture", None)
        pixels = None if picture is None else np.asarray(picture.convert("RGB"), dtype=np.uint8)
        paints.append(linear_factor((1, 1, 1) if factor is None else (np.asarray(factor) / 255).tolist(), pixels))
        places = getattr(visual, "uv", None)
        uv.append(np.full((len(part.vertices), 2), np.nan) if places is None else np.asarray(places, dtype=np.float64))
        painted = visual.kind == "vertex"
        rgb.append(visual.vertex_colors[:, :3] / 255 if painted else np.full((len(part.vertices), 3), np.nan))
    painted = [visual.kind == "vertex" for visual in visuals]
    if any(painted) and any(paint.picture is not None for paint in paints):
        raise _Fault("has textures on some of its meshes and vertex colours on others; bake them into one texture")
    if any(painted):
        flat = [np.where(np.isnan(of), np.array(paint.rgb) / 255, of) for of, paint in zip(rgb, paints, strict=True)]
        return replace(polygons, rgb=np.concatenate(flat))
    if not any(getattr(visual, "material", None) is not None for visual in visuals):
        return polygons
    paint_of = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
    return replace(polygons, uv=np.concatenate(uv)[polygons.corners], paints=paints, paint_of=paint_of)


# Numbers in text


def _numbers(text: bytes, dtype: type[np.int64] | type[np.float64]) -> NDArray[Any] | None:
    """All numbers of a text, separated by white space; None if something else is in it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # so numpy says that it has not come to the end
        try:
            return np.fromstring(text, dtype, sep=" ") if text.strip() else np.empty(0, dtype)
        except (DeprecationWarning, ValueError):
            return None


def _number(word: bytes, place: str) -> float:
    try:
        return float(word)
    except ValueError:
        advice = "; decimals need a point" if re.fullmatch(rb"[+-]?\d*,\d+(?:[eE][+-]?\d+)?", word) else ""
        raise _Fault(f"{place}: {_shown(word)} is not a number{advice}") from None


def _coordinates(words: Sequence[bytes], place: str) -> list[float]:
    numbers = [_number(word, place) for word in words]
    if len(numbers) != 3:
        raise _Fault(f"{place}: three coordinates are needed, not {len(numbers)}")
    return numbers


def _table(vertices: list[list[float]]) -> Floats:
    return np.array(vertices, dtype=np.float64).reshape(-1, 3)


def _shown(text: bytes) -> str:
    return repr(text[:40].decode("latin-1"))


_READERS: Mapping[str, Callable[[bytes, Path | None], _Polygons]] = {
    ".ply": _read_ply,
    ".stl": _read_stl,
    ".obj": _read_obj,
    ".off": _read_off,
    ".glb": _read_glb,
}
SUFFIXES = (*_READERS, *CAD_SUFFIXES)
