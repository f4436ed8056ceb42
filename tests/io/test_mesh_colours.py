"""Colours and textures of mesh files: each kind of file says the same of the same painted plate."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image

from synthetless.errors import UserError
from synthetless.io.meshes import TriangleMesh, read_mesh

RED, GREEN, BLUE, YELLOW = (200, 30, 20), (40, 180, 60), (30, 60, 190), (220, 210, 50)
CORNERS = [(0, 0, 0), (2, 0, 0), (4, 0, 0), (0, 2, 0), (2, 2, 0), (4, 2, 0)]
LEFT, RIGHT = (0, 1, 4, 3), (1, 2, 5, 4)
"""Two squares side by side."""
PLACES = {LEFT: [(0, 0), (0.5, 0), (0.5, 1), (0, 1)], RIGHT: [(0.5, 0), (1, 0), (1, 1), (0.5, 1)]}
"""The left and the right half of a picture."""


def picture(left: tuple[int, int, int], right: tuple[int, int, int]) -> NDArray[np.uint8]:
    """Left and right half, and black above the middle."""
    pixels = np.zeros((64, 64, 3), dtype=np.uint8)
    pixels[32:, :32], pixels[32:, 32:] = left, right
    return pixels


def write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    path.write_bytes(cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())


def colour_at(mesh: TriangleMesh, x: float, y: float) -> list[int]:
    """sRGB of the plate at a point."""
    assert mesh.colours is not None
    corners = mesh.vertices_mm[mesh.faces].transpose(0, 2, 1).copy()
    corners[:, 2] = 1
    of_faces = np.linalg.solve(corners, np.array([x, y, 1.0]).reshape(1, 3, 1))[..., 0]
    k = int(of_faces.min(axis=1).argmax())
    weights = of_faces[k]
    if mesh.colours.vertex_rgb is not None:
        return np.rint(weights @ mesh.colours.vertex_rgb[mesh.faces[k]]).astype(int).tolist()
    assert mesh.colours.texture is not None and mesh.colours.corner_uv is not None
    height, width, _ = mesh.colours.texture.shape
    u, v = (weights @ mesh.colours.corner_uv[k]) % 1
    return mesh.colours.texture[height - 1 - int(v * height), int(u * width)].astype(int).tolist()


def obj_of(faces: dict[tuple[int, ...], str], vertex_colours: bool = False) -> str:
    lines = ["mtllib plate.mtl"]
    lines += [" ".join(map(str, ("v", *xyz, *((0.5, 0.25, 1) if vertex_colours else ())))) for xyz in CORNERS]
    lines += [f"vt {u} {v}" for square in (LEFT, RIGHT) for u, v in PLACES[square]]
    for square, material in faces.items():
        first = 1 if square == LEFT else 5
        lines += [f"usemtl {material}", "f " + " ".join(f"{c + 1}/{first + k}" for k, c in enumerate(square))]
    return "\n".join(lines) + "\n"


def test_an_obj_file_with_a_texture(tmp_path: Path) -> None:
    write_png(tmp_path / "skin.png", picture(RED, GREEN))
    (tmp_path / "plate.mtl").write_text("newmtl skin\nKd 0.1 0.1 0.1\nmap_Kd skin.png\n")
    (tmp_path / "plate.obj").write_text(obj_of({LEFT: "skin", RIGHT: "skin"}))
    mesh = read_mesh(tmp_path / "plate.obj", colours=True)
    assert colour_at(mesh, 1.0, 0.6) == list(RED)
    assert colour_at(mesh, 3.0, 0.6) == list(GREEN)
    assert colour_at(mesh, 1.0, 1.6) == [0, 0, 0], "v points upwards"


def test_an_obj_file_with_pictures_and_flat_colours(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", picture(RED, GREEN))
    write_png(tmp_path / "b.png", np.full((16, 96, 3), BLUE, dtype=np.uint8))
    mtl = "newmtl a\nmap_Kd -clamp on a.png\nnewmtl b\nmap_Kd b.png\nnewmtl flat\nKd 1 0.5 0\n"
    (tmp_path / "plate.mtl").write_text(mtl)
    for right, expected in (("b", BLUE), ("flat", (255, 128, 0))):
        (tmp_path / "plate.obj").write_text(obj_of({LEFT: "a", RIGHT: right}))
        mesh = read_mesh(tmp_path / "plate.obj", colours=True)
        assert colour_at(mesh, 1.0, 0.6) == list(RED)
        assert colour_at(mesh, 1.0, 1.6) == [0, 0, 0]
        assert colour_at(mesh, 3.0, 0.6) == list(expected)
        assert mesh.faces.tolist() == read_mesh(tmp_path / "plate.obj").faces.tolist()


def test_vertex_colours_of_an_obj_file(tmp_path: Path) -> None:
    (tmp_path / "plate.obj").write_text(obj_of({LEFT: "x", RIGHT: "x"}, vertex_colours=True).replace("mtllib", "#"))
    assert colour_at(read_mesh(tmp_path / "plate.obj", colours=True), 1.0, 0.6) == [128, 64, 255]


@pytest.mark.parametrize("kind", ["uchar", "float"])
def test_vertex_colours_of_a_ply_file(tmp_path: Path, kind: str) -> None:
    full = 1 if kind == "uchar" else 255
    rows = [(*xyz, *(c / full for c in RED)) for xyz in CORNERS]
    text = f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n"
    text += "".join(f"property float {axis}\n" for axis in "xyz")
    text += "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    text += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    text += "\n".join(" ".join(f"{v:g}" for v in row) for row in rows) + "\n4 0 1 4 3\n4 1 2 5 4\n"
    (tmp_path / "plate.ply").write_text(text)
    mesh = read_mesh(tmp_path / "plate.ply", colours=True)
    assert colour_at(mesh, 3.0, 0.6) == list(RED)
    assert read_mesh(tmp_path / "plate.ply").colours is None


def bop_ply(texture: str = "plate.png") -> str:
    """As YCB-V of BOP has it: a texture, and its coordinates with each vertex."""
    text = f"ply\nformat ascii 1.0\ncomment TextureFile {texture}\nelement vertex 4\n"
    text += "".join(f"property float {name}\n" for name in ("x", "y", "z", "texture_u", "texture_v"))
    text += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    return text + "0 0 0 0 0\n4 0 0 1 0\n4 2 0 1 1\n0 2 0 0 1\n3 0 1 2\n3 0 2 3\n"


def test_a_texture_of_a_ply_file(tmp_path: Path) -> None:
    write_png(tmp_path / "plate.png", picture(BLUE, YELLOW))
    (tmp_path / "plate.ply").write_text(bop_ply())
    mesh = read_mesh(tmp_path / "plate.ply", colours=True)
    assert mesh.is_verbatim and mesh.texture_file == "plate.png"
    assert colour_at(mesh, 1.0, 0.3) == list(BLUE)
    assert colour_at(mesh, 3.0, 0.3) == list(YELLOW)


def plate(visual: object = None) -> trimesh.Trimesh:
    faces = [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]]
    return trimesh.Trimesh(np.array(CORNERS, dtype=float), faces, process=False, visual=visual)


def test_a_texture_of_a_glb_file(tmp_path: Path) -> None:
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture(RED, GREEN)))
    uv = [(x / 4, y / 2) for x, y, _ in CORNERS]
    plate(trimesh.visual.TextureVisuals(uv=uv, material=material)).export(tmp_path / "plate.glb")
    mesh = read_mesh(tmp_path / "plate.glb", colours=True)
    assert colour_at(mesh, 1.0, 0.6) == list(RED)
    assert colour_at(mesh, 3.0, 0.6) == list(GREEN)
    assert colour_at(mesh, 3.0, 1.6) == [0, 0, 0]


def test_flat_materials_of_a_glb_file_with_parts_that_are_moved(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    for k, factor in enumerate([(255, 0, 0, 255), (0, 255, 0, 255)]):
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=factor)
        part = plate(trimesh.visual.TextureVisuals(material=material))
        scene.add_geometry(part, transform=trimesh.transformations.translation_matrix([10.0 * k, 0, 0]))
    scene.export(tmp_path / "plates.glb")
    mesh = read_mesh(tmp_path / "plates.glb", colours=True)
    assert len(mesh.faces) == 8 and len(mesh.vertices_mm) == 12
    assert colour_at(mesh, 1.0, 0.6) == [255, 0, 0]
    assert colour_at(mesh, 13.0, 0.6) == [0, 255, 0]


def test_vertex_colours_of_a_glb_file(tmp_path: Path) -> None:
    plate(trimesh.visual.ColorVisuals(vertex_colors=[(*BLUE, 255)] * 6)).export(tmp_path / "plate.glb")
    mesh = read_mesh(tmp_path / "plate.glb", colours=True)
    assert colour_at(mesh, 1.0, 0.6) == list(BLUE)
    assert len(read_mesh(tmp_path / "plate.glb").vertices_mm) == 6


@pytest.mark.parametrize("kind", ["texture", "vertices"])
def test_what_is_written_is_read_again(tmp_path: Path, kind: str) -> None:
    if kind == "texture":
        write_png(tmp_path / "skin.png", picture(RED, GREEN))
        (tmp_path / "plate.mtl").write_text("newmtl skin\nmap_Kd skin.png\nnewmtl flat\nKd 0 1 0\n")
        (tmp_path / "plate.obj").write_text(obj_of({LEFT: "skin", RIGHT: "flat"}))
    else:
        (tmp_path / "plate.obj").write_text(obj_of({LEFT: "x", RIGHT: "x"}, vertex_colours=True).replace("mtllib", "#"))
    mesh = read_mesh(tmp_path / "plate.obj", colours=True)
    (tmp_path / "again.ply").write_bytes(mesh.to_ply("again.png"))
    assert mesh.colours is not None
    if mesh.colours.texture is not None:
        write_png(tmp_path / "again.png", mesh.colours.texture)
    again = read_mesh(tmp_path / "again.ply", colours=True)
    assert again.is_verbatim and again.colours is not None
    for name in ("vertex_rgb", "texture", "corner_uv"):
        np.testing.assert_array_equal(getattr(again.colours, name), getattr(mesh.colours, name))
    np.testing.assert_array_equal(again.faces, mesh.faces)
    theirs = trimesh.load(tmp_path / "again.ply", process=False)
    np.testing.assert_array_equal(theirs.triangles, mesh.vertices_mm[mesh.faces])


def test_colours_that_are_not_asked_for_are_not_even_looked_for(tmp_path: Path) -> None:
    (tmp_path / "plate.obj").write_text(obj_of({LEFT: "lost", RIGHT: "lost"}))
    (tmp_path / "plate.ply").write_text(bop_ply("lost.png"))
    assert read_mesh(tmp_path / "plate.obj").colours is None
    assert b"red" not in read_mesh(tmp_path / "plate.ply").to_ply()


@pytest.mark.parametrize(
    ("files", "told"),
    [
        ({}, "names the materials plate.mtl, which are not there"),
        ({"plate.mtl": "newmtl other\nKd 1 1 1\n"}, "uses the material skin, which plate.mtl does not define"),
        ({"plate.mtl": "newmtl skin\nmap_Kd lost.png\n"}, "names the texture lost.png, which is not there"),
        ({"plate.mtl": "newmtl skin\nmap_Kd bad.png\n", "bad.png": "text"}, "cannot be decoded as an image"),
        ({"plate.mtl": "newmtl skin\nKd 1 1\n"}, "line 2 of plate.mtl: Kd '1 1' is not three numbers"),
        ({"plate.mtl": "Kd 1 1 1\n"}, "line 1 of plate.mtl: Kd before any newmtl"),
        ({"plate.mtl": "newmtl skin\n", "plate.obj": "-"}, "there are only 8"),
    ],
)
def test_damage_is_told_in_one_line(tmp_path: Path, files: dict[str, str], told: str) -> None:
    (tmp_path / "plate.obj").write_text(obj_of({LEFT: "skin", RIGHT: "skin"}))
    for name, content in files.items():
        if content == "-":
            content = (tmp_path / name).read_text().replace("/8", "/99")  # noqa: PLW2901
        (tmp_path / name).write_text(content)
    with pytest.raises(UserError, match=r"^[^\n]*$") as error:
        read_mesh(tmp_path / "plate.obj", colours=True)
    assert told in str(error.value)


@pytest.mark.parametrize("content", [b"", b"glTF", b"no glb at all, but some text"])
def test_a_glb_file_that_is_none_is_told_in_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "plate.glb").write_bytes(content)
    with pytest.raises(UserError, match=r"^[^\n]*cannot be read as a GLB file[^\n]*$"):
        read_mesh(tmp_path / "plate.glb")
