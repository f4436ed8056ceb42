"""Writers of mesh files, as odd as files of other programs are, for the tests of the reader."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Solid:
    """A closed surface of polygons.

    Attributes:
        points: (V, 3) corners.
        polygons: vertex numbers of each, counterclockwise from outside.
        area: of the whole surface.
        volume: inside it.
        shadow: area seen from above.
    """

    points: Sequence[tuple[float, float, float]]
    polygons: Sequence[Sequence[int]]
    area: float
    volume: float
    shadow: float

    def turned(self, by: int) -> Solid:
        """The same, each polygon beginning with another corner."""
        turned = [[*p[by % len(p) :], *p[: by % len(p)]] for p in self.polygons]
        return Solid(self.points, turned, self.area, self.volume, self.shadow)


def prism(outline: Sequence[tuple[float, float]], height: float) -> Solid:
    """A prism over a simple polygon, which may be concave."""
    n = len(outline)
    points = [(x, y, z) for z in (0.0, height) for x, y in outline]
    sides = [[i, (i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    ring = np.array(outline)
    after = np.roll(ring, -1, axis=0)
    base = float((ring[:, 0] * after[:, 1] - ring[:, 1] * after[:, 0]).sum() / 2)
    around = float(np.linalg.norm(after - ring, axis=1).sum())
    polygons = [list(range(n))[::-1], list(range(n, 2 * n)), *sides]
    return Solid(points, polygons, 2 * base + around * height, base * height, base)


L_PRISM = prism([(0, 0), (40, 0), (40, 10), (10, 10), (10, 40), (0, 40)], 5)
HEXAGON = prism([(20 * np.cos(a), 20 * np.sin(a)) for a in np.arange(6) * np.pi / 3], 12)
BOX = prism([(0, 0), (30, 0), (30, 20), (0, 20)], 10)
TRIANGLES = Solid(BOX.points, [t for a, b, c, d in BOX.polygons for t in ((a, b, c), (a, c, d))], *(2200, 6000, 600))
ARROW = prism([(0, 0), (30, 15), (0, 30), (10, 15)], 8)  # a concave quad on top and below
_TEETH = [(50, 30), (40, 30), (40, 5), (30, 5), (30, 30), (20, 30), (20, 5), (10, 5), (10, 30), (0, 30)]
COMB = prism([(0, 0), (50, 0), *_TEETH], 4)
T_EDGE = prism([(0, 0), (10, 0), (20, 0), (30, 0), (30, 20), (15, 20), (0, 20)], 10)  # corners on straight edges
KEYHOLE = Solid(  # a frame whose top and bottom are each one polygon that visits the hole over a bridge
    [
        *((x, y, z) for z in (0.0, 5.0) for x, y in ((0, 0), (30, 0), (30, 30), (0, 30))),
        *((x, y, z) for z in (0.0, 5.0) for x, y in ((10, 10), (20, 10), (20, 20), (10, 20))),
    ],
    [
        [4, 5, 6, 7, 4, 12, 15, 14, 13, 12],
        [0, 8, 9, 10, 11, 8, 0, 3, 2, 1],
        *([i, (i + 1) % 4, 4 + (i + 1) % 4, 4 + i] for i in range(4)),
        *([8 + (i + 1) % 4, 8 + i, 12 + i, 12 + (i + 1) % 4] for i in range(4)),
    ],
    *(2 * 800 + 5 * 160, 800 * 5, 800),
)


def ply(solid: Solid, newline: str = "\n", comment: bytes = b"", count: int | None = None) -> bytes:
    """PLY as text."""
    head = [
        *("ply", "format ascii 1.0", f"element vertex {len(solid.points)}"),
        *("property double x", "property double y", "property double z"),
        *(f"element face {count or len(solid.polygons)}", "property list uchar int vertex_indices", "end_header"),
    ]
    body = [" ".join(map(repr, map(float, p))) for p in solid.points]
    body += [" ".join(map(str, (len(p), *p))) for p in solid.polygons]
    text = newline.join([*head, *body, ""]).encode()
    return (
        text.replace(b"element vertex", b"comment " + comment + newline.encode() + b"element vertex")
        if comment
        else text
    )


def binary_ply(solid: Solid, order: str = "<", face_extras: bool = False, edges: int = 0, stray: int = 0) -> bytes:
    """PLY in binary: with normals, and if wanted with colours and texture coordinates of faces, edges, stray points."""
    name = {"<": "little", ">": "big"}[order]
    head = [
        *("ply", f"format binary_{name}_endian 1.0", f"element vertex {stray + len(solid.points)}"),
        *("property float x", "property float y", "property float z", "property uchar red", "property double quality"),
        *([f"element edge {edges}", "property int vertex1", "property int vertex2"] if edges else []),
        f"element face {len(solid.polygons)}",
        *(["property uchar flags", "property list uchar float texcoord"] if face_extras else []),
        *("property list uint8 uint32 vertex_index", "end_header", ""),
    ]
    points = [(1e6, -1e6, 1e6)] * stray + list(solid.points)
    body = b"".join(struct.pack(f"{order}3fBd", *p, 7, 0.5) for p in points)
    body += struct.pack(f"{order}{2 * edges}i", *range(2 * edges))
    rows = []
    for p in solid.polygons:
        extras = struct.pack(f"{order}BB{2 * len(p)}f", 1, 2 * len(p), *([0.25] * (2 * len(p)))) if face_extras else b""
        rows.append(extras + struct.pack(f"{order}B{len(p)}I", len(p), *(stray + i for i in p)))
    return "\n".join(head).encode() + body + b"".join(rows)


def obj(solid: Solid, corner: str = "{0}", relative: bool = False) -> bytes:
    """OBJ; ``corner`` is how a corner is written, for example ``{0}/1/1``."""
    lines = ["# odd", "mtllib none.mtl", "o part", "vt 0 0", "vn 0 0 1"]
    lines += ["v " + " ".join(map(repr, map(float, p))) for p in solid.points]
    n = len(solid.points)
    lines += ["f " + " ".join(corner.format(i - n if relative else i + 1) for i in p) for p in solid.polygons]
    return "\n".join([*lines, "l 1 2", ""]).encode()


def off(solid: Solid, kind: str = "OFF", extra: str = "", colour: str = "") -> bytes:
    """OFF; ``extra`` follows each vertex, ``colour`` each face."""
    lines = [kind, "# odd", f"{len(solid.points)} {len(solid.polygons)} 0", ""]
    lines += [" ".join(map(repr, map(float, p))) + f" {extra}" for p in solid.points]
    lines += [" ".join(map(str, (len(p), *p))) + f" {colour}" for p in solid.polygons]
    return "\n".join([*lines, ""]).encode()


def stl(solid: Solid, name: str = "part", newline: str = "\n") -> bytes:
    """STL as text, of triangles."""
    lines = [f"solid {name}"]
    for polygon in solid.polygons:
        lines += ["facet normal 0 0 0", "  outer loop"]
        lines += ["    vertex " + " ".join(repr(float(value)) for value in solid.points[i]) for i in polygon]
        lines += ["  endloop", "endfacet"]
    return newline.join([*lines, f"endsolid {name}", ""]).encode()


def binary_stl(solid: Solid, header: bytes = b"", spare: bytes = b"", declared: int | None = None) -> bytes:
    """STL in binary, of triangles."""
    count = len(solid.polygons) if declared is None else declared
    body = b"".join(
        struct.pack("<12fH", 0, 0, 0, *(v for i in polygon for v in solid.points[i]), 0) for polygon in solid.polygons
    )
    return header.ljust(80, b" ")[:80] + struct.pack("<I", count) + body + spare
