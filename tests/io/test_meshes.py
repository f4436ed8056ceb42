"""Mesh files: each odd one is read as what it means, or refused in one line that names what is wrong with it."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from mesh_files import (
    ARROW,
    BOX,
    COMB,
    HEXAGON,
    KEYHOLE,
    L_PRISM,
    T_EDGE,
    TRIANGLES,
    Solid,
    binary_ply,
    binary_stl,
    obj,
    off,
    ply,
    prism,
    stl,
)

from synthetless.errors import UserError
from synthetless.io.meshes import Floats, TriangleMesh, diameter, read_mesh

SOLIDS = {
    "box": BOX,
    "L": L_PRISM,
    "hexagon": HEXAGON,
    "arrow": ARROW,
    "comb": COMB,
    "T": T_EDGE,
    "keyhole": KEYHOLE,
    "triangles": TRIANGLES,
}
WRITERS = {"text.ply": ply, "binary.ply": binary_ply, "part.obj": obj, "part.off": off}

READ: dict[str, tuple[bytes, Solid]] = {
    "windows.ply": (ply(L_PRISM, "\r\n"), L_PRISM),
    "old_mac.ply": (ply(L_PRISM, "\r"), L_PRISM),
    "latin1.ply": (ply(HEXAGON, comment="Größe in mm, André".encode("latin-1")), HEXAGON),
    "utf8.ply": (ply(HEXAGON, comment="部品".encode()), HEXAGON),
    "end_header_comment.ply": (ply(HEXAGON, comment=b"end_header follows"), HEXAGON),
    "blank_lines.ply": (ply(L_PRISM).replace(b"0\n", b"0\n\n  \n"), L_PRISM),
    "spaces.ply": (ply(L_PRISM).replace(b" ", b"  \t").replace(b"ply  \t", b"ply ").replace(b"\n", b" \n"), L_PRISM),
    "no_last_newline.ply": (ply(L_PRISM).rstrip(), L_PRISM),
    "text_after.ply": (ply(TRIANGLES) + b"made by hand\n", TRIANGLES),
    "texcoord.ply": (
        b"\n".join(
            line + b" 2 0.5 0.25" if line.startswith(b"4 ") else line
            for line in ply(BOX)
            .replace(b"vertex_indices", b"vertex_indices\nproperty list uchar float texcoord")
            .split(b"\n")
        ),
        BOX,
    ),
    "big_endian.ply": (binary_ply(HEXAGON, ">"), HEXAGON),
    "extras.ply": (binary_ply(L_PRISM, face_extras=True), L_PRISM),
    "extras_uniform.ply": (binary_ply(TRIANGLES, face_extras=True), TRIANGLES),
    "edges.ply": (binary_ply(L_PRISM, edges=5), L_PRISM),
    "stray.ply": (binary_ply(L_PRISM, stray=3), L_PRISM),
    "spare_bytes.ply": (binary_ply(TRIANGLES) + b"\0\0\0", TRIANGLES),
    "spare_bytes_mixed.ply": (binary_ply(HEXAGON) + b"\r\n", HEXAGON),
    "upper_case.PLY": (binary_ply(HEXAGON), HEXAGON),
    "degenerate_faces.ply": (
        binary_ply(Solid(BOX.points, [*BOX.polygons, [0, 1], [2], [], [3, 3, 3, 3]], 2200, 6000, 600)),
        BOX,
    ),
    "repeated_corner.ply": (
        ply(Solid(BOX.points, [[*p, p[-1]] for p in BOX.polygons], 2200, 6000, 600)),
        BOX,
    ),
    "floats_as_indices.ply": (ply(TRIANGLES).replace(b"uchar int", b"uchar float"), TRIANGLES),
    "textured.obj": (obj(L_PRISM, "{0}/1/1"), L_PRISM),
    "normals.obj": (obj(HEXAGON, "{0}//1"), HEXAGON),
    "relative.obj": (obj(ARROW, relative=True), ARROW),
    "continued.obj": (obj(COMB).replace(b" 12", b" \\\n 12"), COMB),
    "windows.obj": (obj(COMB).replace(b"\n", b"\r\n"), COMB),
    "colours.obj": (obj(L_PRISM).replace(b".0\nv", b".0 1 0 0\nv"), L_PRISM),
    "comments.obj": (obj(L_PRISM).replace(b"\nf ", b" # \xe4\nf "), L_PRISM),
    "counts_on_the_first_line.off": (off(HEXAGON).replace(b"OFF\n# odd\n", b"OFF "), HEXAGON),
    "colours.off": (off(HEXAGON, "COFF", "255 0 0 255"), HEXAGON),
    "normals.off": (off(L_PRISM, "NOFF", "0 0 1"), L_PRISM),
    "face_colours.off": (off(L_PRISM, colour="0.5 0.5 0.5"), L_PRISM),
    "windows.off": (off(L_PRISM).replace(b"\n", b"\r\n"), L_PRISM),
    "text.stl": (stl(TRIANGLES), TRIANGLES),
    "windows.stl": (stl(TRIANGLES, newline="\r\n"), TRIANGLES),
    "upper_case.STL": (stl(TRIANGLES).upper(), TRIANGLES),
    "named_facet.stl": (stl(TRIANGLES, "facet normal with vertex 1 2 3 endfacet"), TRIANGLES),
    "named_endsolid.stl": (stl(TRIANGLES, "endsolid"), TRIANGLES),
    "unnamed.stl": (stl(TRIANGLES, ""), TRIANGLES),
    "indented.stl": (b"  " + stl(TRIANGLES).replace(b"\n", b"\n\t"), TRIANGLES),
    "two_solids.stl": (
        stl(Solid(BOX.points, TRIANGLES.polygons[:6], 0, 0, 0))
        + stl(Solid(BOX.points, TRIANGLES.polygons[6:], 0, 0, 0)),
        TRIANGLES,
    ),
    "binary.stl": (binary_stl(TRIANGLES), TRIANGLES),
    "spare_bytes.stl": (binary_stl(TRIANGLES, spare=b"\0" * 17), TRIANGLES),
    "spare_byte.stl": (binary_stl(TRIANGLES, spare=b"\n"), TRIANGLES),
    "spare_triangle.stl": (binary_stl(TRIANGLES, spare=b"\1" * 50), TRIANGLES),
    "solid_in_binary.stl": (binary_stl(TRIANGLES, b"solid facet vertex"), TRIANGLES),
    "zero_header.stl": (binary_stl(TRIANGLES, b"\0" * 80), TRIANGLES),
}

_HEAD = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
_FACES = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
_POINTS = b"0 0 0\n1 0 0\n0 1 0\n"
_BOW_TIE = Solid([(0, 0, 0), (9, 9, 0), (9, 0, 0), (0, 9, 0)], [[0, 1, 2, 3]], 0, 0, 0)
_STAR = Solid([(np.cos(a), np.sin(a), 0.0) for a in np.arange(5) * 4 * np.pi / 5], [list(range(5))], 0, 0, 0)
_TWICE_ROUND = Solid(
    [((3 + k / 9) * np.cos(k * np.pi / 3), (3 + k / 9) * np.sin(k * np.pi / 3), 0.0) for k in range(12)],
    [list(range(12))],
    *(0, 0, 0),
)
_CUT_IN_VERTICES = binary_ply(HEXAGON).index(b"end_header") + 11 + 3 * 21 + 5

REFUSED: dict[str, tuple[bytes, str]] = {
    "empty.ply": (b"", "is empty"),
    "empty.stl": (b"", "is empty"),
    "empty.off": (b" \n", "is empty"),
    "empty.obj": (b"", "holds no faces"),
    "pointer.ply": (b"version https://git-lfs.github.com/spec/v1\n", "not a PLY file"),
    "stl_inside.ply": (binary_stl(TRIANGLES), "not a PLY file"),
    "header_cut.ply": (binary_ply(HEXAGON)[:150], "no line 'end_header'"),
    "vertices_cut.ply": (
        binary_ply(HEXAGON)[:_CUT_IN_VERTICES],
        "cut off after 3 of 12 rows of vertex",
    ),
    "faces_cut.ply": (binary_ply(HEXAGON)[:-20], "cut off after 6 of 8 rows of face"),
    "quads_cut.ply": (binary_ply(BOX)[:-1], "cut off after 5 of 6 rows of face"),
    "text_cut.ply": (ply(L_PRISM)[:-14], "cut off after 6 of 8 rows of face"),
    "row_cut.ply": (ply(L_PRISM)[:-4], "cut off after 7 of 8 rows of face"),
    "more_declared.ply": (ply(BOX, count=7), "cut off after 6 of 7 rows of face"),
    "bomb.ply": (ply(BOX).replace(b"vertex 8", b"vertex 999999999999999999"), "line 18 has 5 values"),
    "binary_bomb.ply": (binary_ply(BOX).replace(b"vertex 8", b"vertex 999999999999999999"), "cut off after"),
    "face_bomb.ply": (binary_ply(BOX).replace(b"face 6", b"face 99999999999999999"), "cut off after"),
    "list_bomb.ply": (
        binary_ply(BOX).replace(b"list uint8 uint32", b"list uint32 double"),
        "cut off after 0 of 6 rows of face",
    ),
    "negative_list.ply": (
        binary_ply(BOX).replace(b"list uint8", b"list int8")[:-17] + b"\xff" * 17,
        "has a list of -1 values",
    ),
    "decimal_comma.ply": (ply(BOX).replace(b"30.0", b"30,0"), "line 11: '30,0' is not a number; decimals need a point"),
    "word.ply": (ply(BOX).replace(b"30.0", b"wide"), "line 11: 'wide' is not a number"),
    "two_coordinates.ply": (ply(BOX).replace(b"\n30.0 0.0 0.0", b"\n30.0 0.0", 1), "line 11 has 2 values"),
    "shifted_values.ply": (
        ply(BOX).replace(b"\n30.0 0.0 0.0\n30.0 20.0 0.0", b"\n30.0 0.0\n0.0 30.0 20.0 0.0"),
        "line 11 has 2 values",
    ),
    "no_format.ply": (ply(BOX).replace(b"format ascii 1.0\n", b""), "no format"),
    "format_2.ply": (ply(BOX).replace(b"ascii", b"ebcdic"), "line 2 of the header"),
    "odd_type.ply": (ply(BOX).replace(b"double z", b"half z"), "line 6 of the header"),
    "negative_count.ply": (ply(BOX).replace(b"vertex 8", b"vertex -8"), "line 3 of the header"),
    "no_z.ply": (
        _HEAD.replace(b"float z", b"float w") + _FACES + _POINTS + b"3 0 1 2\n",
        "no properties x, y and z",
    ),
    "points.ply": (_HEAD + b"end_header\n" + _POINTS, "holds no faces"),
    "no_faces.ply": (_HEAD + _FACES.replace(b"face 1", b"face 0") + _POINTS, "holds no faces"),
    "only_edges.ply": (_HEAD + _FACES + _POINTS + b"2 0 1\n", "holds no faces"),
    "no_list.ply": (
        _HEAD + _FACES.replace(b"vertex_indices", b"corners") + _POINTS + b"3 0 1 2\n",
        "no list called vertex_indices",
    ),
    "strips.ply": (
        _HEAD + _FACES.replace(b"face", b"tristrips") + _POINTS + b"3 0 1 2\n",
        "triangle strips",
    ),
    "nan.ply": (_HEAD + _FACES + b"0 0 0\n1 nan 0\n0 1 0\n3 0 1 2\n", "vertex 1 is [1.0, nan, 0.0]"),
    "overflow.ply": (_HEAD + _FACES + b"0 0 0\n1 1e60 0\n0 1 0\n3 0 1 2\n", "vertex 1 is [1.0, inf, 0.0]"),
    "beyond_all_parts.off": (off(BOX).replace(b"30.0", b"1e300"), "every coordinate must be finite"),
    "saw.obj": (obj(prism([(0, 0), (30000, 0), *((x, 9 + x % 2) for x in range(20000, 0, -1))], 5)), "20002 corners"),
    "far_index.ply": (
        _HEAD + _FACES + _POINTS + b"3 0 1 3\n",
        "vertex 3, but there are only 3",
    ),
    "negative_index.ply": (_HEAD + _FACES + _POINTS + b"3 0 1 -1\n", "face 0 names vertex -1"),
    "half_index.ply": (_HEAD + _FACES + _POINTS + b"3 0 1 1.5\n", "names vertex 1.5; whole numbers"),
    "nan_index.ply": (_HEAD + _FACES + _POINTS + b"3 0 1 nan\n", "whole numbers are needed"),
    "bow_tie.ply": (ply(_BOW_TIE), "face 0 crosses itself"),
    "star.obj": (obj(_STAR), "face 0 crosses itself"),
    "twice_round.off": (off(_TWICE_ROUND), "face 0 crosses itself"),
    "binary_cut.stl": (binary_stl(TRIANGLES)[:-60], "cut off after 10 of 12 triangles"),
    "binary_header.stl": (binary_stl(TRIANGLES, b"part")[:60], "60 bytes are fewer than its header has"),
    "declares_none.stl": (binary_stl(TRIANGLES, declared=0), "says that it holds no faces, but 12 triangles follow"),
    "nothing.stl": (stl(Solid([], [], 0, 0, 0)), "holds no faces"),
    "binary_nothing.stl": (binary_stl(Solid([], [], 0, 0, 0)), "holds no faces"),
    "text_cut.stl": (stl(TRIANGLES)[:-300], "cut off after 9 triangles"),
    "text_cut_between.stl": (stl(TRIANGLES)[: -len(b"endsolid part\n")], "cut off after 12 triangles"),
    "decimal_comma.stl": (
        stl(TRIANGLES).replace(b"30.0", b"30,0"),
        "line 5: '30,0' is not a number; decimals need a point",
    ),
    "two_coordinates.stl": (
        stl(TRIANGLES).replace(b"vertex 30.0", b"vertex", 1),
        "three coordinates are needed, not 2",
    ),
    "quads.stl": (stl(BOX), "24 vertices in 6 facets"),
    "page.stl": (b"<html><body>404 not found</body></html>" * 9, "or not an STL file"),
    "decimal_comma.obj": (obj(BOX).replace(b"30.0", b"30,0"), "line 7: '30,0' is not a number; decimals need a point"),
    "two_coordinates.obj": (obj(BOX).replace(b"v 0.0 20.0 0.0", b"v 0.0 20.0"), "three coordinates are needed, not 2"),
    "zero_index.obj": (obj(BOX).replace(b"f 4 3", b"f 0 3"), "'0' is not a vertex number; they count from 1"),
    "far_index.obj": (obj(BOX).replace(b"f 4 3", b"f 40 3"), "names vertex 39, but there are only 8"),
    "before_the_first.obj": (obj(BOX).replace(b"f 4 3", b"f -9 3"), "names vertex -1"),
    "word.obj": (obj(BOX).replace(b"f 4 3", b"f four 3"), "'four' is not a vertex number"),
    "surface.obj": (b"v 0 0 0\nsurf 0 1 0 1 1 2 3 4\n", "free-form surface"),
    "points.obj": (b"v 0 0 0\nv 1 0 0\np 1 2\n", "holds no faces"),
    "no_name.off": (off(BOX).replace(b"OFF\n", b""), "does not begin with 'OFF'"),
    "binary.off": (b"OFF BINARY\n\0\0\0\1", "'OFF BINARY' is not supported"),
    "four_dimensions.off": (off(BOX, "4OFF", "1"), "'4OFF' is not supported"),
    "no_counts.off": (b"OFF\n", "the numbers of vertices and faces are needed"),
    "words.off": (b"OFF\neight six\n", "the numbers of vertices and faces are needed"),
    "cut.off": (off(BOX)[:-24], "cut off after 4 of 6 faces"),
    "vertices_cut.off": (off(BOX)[:60], "three coordinates are needed, not 1"),
    "bomb.off": (b"OFF\n999999999999999999 1 0\n0 0 0\n", "cut off after 1 of 999999999999999999 vertices"),
    "short_face.off": (off(BOX).replace(b"4 3 2 1 0", b"4 3 2 1"), "line 13: a number of corners"),
    "part.3mf": (b"ISO-10303-21;", "not a mesh file; one that ends in .ply"),
}


def _read(folder: Path, name: str, content: bytes) -> TriangleMesh:
    (folder / name).write_bytes(content)
    return read_mesh(folder / name)


def _is_the(mesh: TriangleMesh, solid: Solid) -> None:
    """Area, volume and shadow of a mesh are those of a solid; an overlap or a hole would change one of them."""
    a, b, c = (mesh.vertices_mm[mesh.faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a) / 2
    assert np.linalg.norm(cross, axis=1).sum() == pytest.approx(solid.area, rel=1e-6)
    assert (a * cross).sum() / 3 == pytest.approx(solid.volume, rel=1e-6)
    assert cross[:, 2].clip(min=0).sum() == pytest.approx(solid.shadow, rel=1e-6)
    assert set(mesh.faces.ravel()) == set(range(len(mesh.vertices_mm)))


@pytest.mark.parametrize("name", SOLIDS)
@pytest.mark.parametrize("writer", WRITERS)
def test_polygons_are_covered_whatever_their_first_corner(name: str, writer: str, tmp_path: Path) -> None:
    solid = SOLIDS[name]
    for first in range(max(map(len, solid.polygons))):
        mesh = _read(tmp_path, writer, WRITERS[writer](solid.turned(first)))
        _is_the(mesh, solid)
        np.testing.assert_allclose(mesh.vertices_mm, solid.points, atol=1e-5)


@pytest.mark.parametrize("name", READ)
def test_an_odd_file_is_read_as_what_it_means(name: str, tmp_path: Path) -> None:
    content, solid = READ[name]
    _is_the(_read(tmp_path, name, content), solid)


@pytest.mark.parametrize("name", REFUSED)
def test_a_bad_file_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    content, reason = REFUSED[name]
    with pytest.raises(UserError) as caught:
        _read(tmp_path, name, content)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / name}: ")
    assert reason in message
    assert "\n" not in message


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "folder.stl").mkdir()
    (tmp_path / "device.obj").symlink_to("/dev/zero")
    (tmp_path / "round.off").symlink_to(tmp_path / "round.off")
    for name, reason in (
        ("pipe.ply", "not a file"),
        ("folder.stl", "not a file"),
        ("device.obj", "not a file"),
        ("round.off", "cannot be read"),
        ("none.ply", "No such file"),
    ):
        with pytest.raises(UserError, match=f"{name}: .*{reason}"):
            read_mesh(tmp_path / name)


@given(content=st.binary(max_size=300), suffix=st.sampled_from([".ply", ".stl", ".obj", ".off"]), data=st.data())
def test_bytes_of_any_kind_are_a_mesh_or_refused(
    content: bytes, suffix: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Random bytes, and good files with a part replaced by them."""
    good = {
        ".ply": [ply(HEXAGON), binary_ply(HEXAGON)],
        ".stl": [stl(TRIANGLES), binary_stl(TRIANGLES)],
        ".obj": [obj(L_PRISM)],
        ".off": [off(L_PRISM)],
    }
    base = data.draw(st.sampled_from([b"", *good[suffix]]))
    place = data.draw(st.integers(0, len(base)))
    path = tmp_path_factory.getbasetemp() / f"fuzz{suffix}"
    path.write_bytes(base[:place] + content + base[place + data.draw(st.integers(0, 40)) :])
    try:
        mesh = read_mesh(path)
    except UserError as error:
        assert "\n" not in str(error)
    else:
        assert len(mesh.faces)
        assert np.isfinite(mesh.vertices_mm).all()


@given(
    radii=st.lists(st.floats(0.2, 1), min_size=4, max_size=14),
    first=st.integers(0, 13),
    warp=st.floats(0, 0.01),
    seed=st.integers(0, 1000),
)
def test_any_polygon_is_covered_once(
    radii: list[float], first: int, warp: float, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Star-shaped outlines of any concavity, turned in space, a little warped: area and normal are the outline's."""
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    flat = 50 * np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    spatial = np.column_stack([flat, 50 * warp * rng.uniform(-1, 1, len(flat))])
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = np.roll(spatial, first, axis=0) @ turn.T + rng.uniform(-100, 100, 3)
    path = tmp_path_factory.getbasetemp() / "polygon.obj"
    path.write_bytes(obj(Solid([tuple(p) for p in points.tolist()], [list(range(len(points)))], 0, 0, 0)))
    mesh = read_mesh(path)
    a, b, c = (mesh.vertices_mm[mesh.faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a) / 2
    after = np.roll(flat, -1, axis=0)
    area = (flat[:, 0] * after[:, 1] - flat[:, 1] * after[:, 0]).sum() / 2
    along = cross @ turn[:, 2]
    assert along.sum() * np.linalg.det(turn) == pytest.approx(area, rel=1e-6)
    assert np.abs(along).sum() == pytest.approx(area, rel=1e-3)
    assert len(mesh.faces) == len(points) - 2


def test_triangles_and_quads_are_read_as_by_others(tmp_path: Path) -> None:
    """Of files that need no care vertices and triangles are those of trimesh, bit for bit and in its order."""
    shapes = [trimesh.creation.icosphere(2, 30), trimesh.creation.annulus(15, 32, 40), trimesh.creation.box((3, 4, 5))]
    for i, shape in enumerate(shapes):
        for kind in ("ply", "stl", "stl_ascii", "obj", "off"):
            path = tmp_path / f"{i}_{kind}.{kind.partition('_')[0]}"
            shape.export(path, file_type=kind)
            mesh, other = read_mesh(path), trimesh.load_mesh(path, process=False)
            np.testing.assert_array_equal(mesh.vertices_mm, other.vertices)
            np.testing.assert_array_equal(mesh.faces, other.faces)
            assert mesh.is_verbatim == (kind == "ply")


def test_quads_are_cut_as_by_others(tmp_path: Path) -> None:
    (tmp_path / "quads.ply").write_bytes(ply(BOX))
    mesh = read_mesh(tmp_path / "quads.ply")
    np.testing.assert_array_equal(mesh.faces, [t for a, b, c, d in BOX.polygons for t in ((a, b, c), (a, c, d))])


@pytest.mark.tless
def test_the_models_of_tless_are_read_as_by_others(tless_models: Path) -> None:
    for path in sorted(tless_models.glob("*.ply"))[::6]:
        mesh, other = read_mesh(path), trimesh.load_mesh(path, process=False)
        assert mesh.vertices_mm.tobytes() == np.ascontiguousarray(other.vertices).tobytes()
        np.testing.assert_array_equal(mesh.faces, other.faces)
        assert mesh.is_verbatim


@pytest.mark.parametrize("name", [name for name in READ if name.lower().endswith(".ply")])
def test_what_is_written_is_what_was_read(name: str, tmp_path: Path) -> None:
    mesh = _read(tmp_path, name, READ[name][0])
    again = _read(tmp_path, "again.ply", mesh.to_ply())
    assert again.is_verbatim
    np.testing.assert_array_equal(again.vertices_mm, mesh.vertices_mm)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    other = trimesh.load_mesh(tmp_path / "again.ply", process=False)
    np.testing.assert_array_equal(other.vertices, mesh.vertices_mm)
    np.testing.assert_array_equal(other.faces, mesh.faces)


def test_line_ends_of_windows_are_no_reason_to_write_a_file_anew(tmp_path: Path) -> None:
    assert _read(tmp_path, "windows.ply", ply(TRIANGLES, "\r\n")).is_verbatim
    assert not _read(tmp_path, "old_mac.ply", ply(TRIANGLES, "\r")).is_verbatim


@pytest.mark.parametrize("name", ["text_after.ply", "stray.ply", "latin1.ply", "spare_bytes.ply", "big_endian.ply"])
def test_a_file_is_verbatim_only_if_all_readers_agree(name: str, tmp_path: Path) -> None:
    assert _read(tmp_path, name, READ[name][0]).is_verbatim == (name == "text_after.ply")


def test_a_scale_multiplies_the_coordinates(tmp_path: Path) -> None:
    (tmp_path / "box.off").write_bytes(off(BOX))
    mesh = read_mesh(tmp_path / "box.off", scale=1000)
    assert mesh.diameter_mm == pytest.approx(1000 * np.sqrt(1400))
    assert mesh.bop_info()["size_y"] == 20000


def _brute(points: Floats) -> float:
    return float(max(np.linalg.norm(points - p, axis=1).max() for p in points))


@pytest.mark.parametrize("spread", [(5, 20, 70), (5, 20, 0), (5, 0, 0), (0, 0, 0), (5, 20, 1e-9), (5, 20, 1e-4)])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 300])
def test_the_diameter_is_the_largest_distance(spread: tuple[float, ...], count: int) -> None:
    """Of bodies, plates, rods and points alike."""
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3)) * spread @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + [100, 0, 0]
    assert diameter(points) == pytest.approx(_brute(points), rel=1e-9, abs=1e-12)


def test_a_prism_is_no_flat_mesh(tmp_path: Path) -> None:
    flat = Solid(BOX.points, BOX.polygons[:1], 0, 0, 0)
    assert _read(tmp_path, "flat.ply", ply(flat)).is_flat
    assert not _read(tmp_path, "thin.ply", ply(prism([(0, 0), (30, 0), (0, 20)], 0.001))).is_flat
