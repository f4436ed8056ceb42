"""Folders of meshes: ids, what is written, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import mesh_files
import numpy as np
import pytest
import trimesh
from detect_shapes import box, cone, l_bracket

from synthetless.errors import UserError
from synthetless.io.files import read_json
from synthetless.io.meshes import read_mesh
from synthetless.io.models import find_meshes, load_models
from synthetless.symmetry import SymmetryGroup, SymmetryTable
from synthetless.symmetry.detection import DetectedFolder, detect_folder, parse_tolerances, report

L_BRACKET = SymmetryGroup.from_name("C2", axis=(1, 0, 1), offset_mm=(0, 10, 0))


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Meshes of three formats, no models_info.json; the cone is in metres."""
    folder = tmp_path_factory.mktemp("bare")
    box(30, 50, 80).export(folder / "housing.STL")
    l_bracket().export(folder / "bracket.obj")
    metres = cone()
    metres.apply_scale(1e-3)
    metres.export(folder / "knob.ply")
    (folder / "notes.txt").write_text("no mesh")
    return folder


@pytest.fixture(scope="module")
def detected(bare: Path) -> DetectedFolder:
    return detect_folder(bare, workers=2)


def test_bare_files_are_numbered_in_alphabetical_order(detected: DetectedFolder) -> None:
    assert detected.are_numbered
    assert [(o.obj_id, o.path.name) for o in detected.objects] == [
        (1, "bracket.obj"),
        (2, "housing.STL"),
        (3, "knob.ply"),
    ]
    assert [o.detected.answer.group.name for o in detected.objects] == ["C2", "D2", "SO(2)"]
    assert "1 = bracket.obj, 2 = housing.STL, 3 = knob.ply" in " ".join(report(detected).split())


def test_metres_are_pointed_out(detected: DetectedFolder) -> None:
    assert [o.warning is None for o in detected.objects] == [True, True, False]
    assert "(knob.ply) is only 0.0685 mm across: are its units metres?" in report(detected)


def test_the_report_fits_a_terminal_and_names_every_cost(detected: DetectedFolder) -> None:
    lines = report(detected).splitlines()
    assert max(map(len, lines)) <= 105
    assert any(line.split()[:4] == ["2", "D2", "z,", "x"] for line in lines)
    assert any(line.startswith(">  D2") for line in lines)


def test_the_table_is_read_back(detected: DetectedFolder, tmp_path: Path) -> None:
    detected.table("atlas").write(tmp_path / "table.json")
    table = SymmetryTable.read(tmp_path / "table.json")
    assert table.scheme == "atlas"
    assert [entry.group for entry in table.entries.values()] == [o.detected.answer.group for o in detected.objects]
    bracket = table.entries[1].group
    np.testing.assert_allclose(bracket.axis, L_BRACKET.axis, atol=1e-4)
    np.testing.assert_allclose(bracket.offset_mm, L_BRACKET.offset_mm, atol=1e-2)


def test_json_holds_everything(detected: DetectedFolder) -> None:
    content = json.loads(json.dumps(detected.to_json(), allow_nan=False))
    bracket = content["objects"][0]
    assert (bracket["file"], bracket["group"]) == ("bracket.obj", "C2")
    assert len(bracket["axis"]) == len(bracket["offset_mm"]) == 3
    assert {"group", "axis", "offset_mm", "max_mm", "p95_mm", "rms_mm"} <= bracket["residuals"][0].keys()
    assert [r["group"] for r in bracket["residuals"] if r["is_answer"]] == ["C2"]
    costs = [r["max_percent"] for r in bracket["residuals"] if r["is_next_larger"]]
    assert len(costs) == 1
    assert costs[0] > 1


def test_bare_files_become_a_models_folder(detected: DetectedFolder, tmp_path: Path) -> None:
    detected.write_models(tmp_path / "models")
    models = load_models(tmp_path / "models")
    assert list(models) == [1, 2, 3]
    assert models[2].diameter_mm == pytest.approx(np.sqrt(30**2 + 50**2 + 80**2))
    for o in detected.objects:
        group = SymmetryGroup.from_bop(models[o.obj_id].info)
        assert group.name == o.detected.answer.group.name
        np.testing.assert_allclose(group.offset_mm, o.detected.answer.group.offset_mm, atol=1e-6)
    with pytest.raises(ValueError, match="would stand beside other meshes"):
        detected.write_models(tmp_path / "models")


def test_a_declared_group_is_measured_as_it_stands(tmp_path: Path) -> None:
    box(30, 50, 80).export(tmp_path / "obj_000007.ply")
    declared = SymmetryGroup.from_name("D4").to_bop()
    (tmp_path / "models_info.json").write_text(json.dumps({"7": {"diameter": 99.0, **declared}}))
    detected = detect_folder(tmp_path, workers=1)
    (o,) = detected.objects
    assert o.obj_id == 7
    assert o.detected.declared is not None
    assert o.detected.declared.residual.max_mm == pytest.approx(10)
    assert o.detected.answer.group.name == "D2"
    assert o.detected.answer_at(10.1) == o.detected.declared
    detected.write_models(tmp_path)
    assert read_json(tmp_path / "models_info.json")["7"]["size_z"] == 80.0


def test_ids_come_from_names(tmp_path: Path) -> None:
    for name in ("obj_000012.ply", "Object 3.stl", "7.OBJ"):
        (tmp_path / name).touch()
    files = find_meshes(tmp_path)
    assert not files.are_numbered
    assert {obj_id: path.name for obj_id, path in files.paths.items()} == {
        3: "Object 3.stl",
        7: "7.OBJ",
        12: "obj_000012.ply",
    }
    (tmp_path / "obj_000003.ply").touch()
    with pytest.raises(ValueError, match=r"Object 3\.stl and obj_000003\.ply are both object 3"):
        find_meshes(tmp_path)


def test_the_diameter_is_the_largest_distance(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(3000, 3)) * [5, 20, 70]
    trimesh.Trimesh(vertices, rng.integers(0, 2900, (5000, 3)), process=False).export(tmp_path / "1.ply")
    mesh = read_mesh(tmp_path / "1.ply", scale=2.0)
    expected = max(np.linalg.norm(mesh.vertices_mm - v, axis=1).max() for v in mesh.vertices_mm)
    assert mesh.diameter_mm == pytest.approx(expected, rel=1e-12)
    info = mesh.bop_info()
    assert info["min_z"] == mesh.vertices_mm[:, 2].min()
    assert info["size_y"] == np.ptp(mesh.vertices_mm[:, 1])


def _ply(vertices: str, faces: str, n: int, m: int) -> str:
    head = f"ply\nformat ascii 1.0\nelement vertex {n}\nproperty float x\nproperty float y\nproperty float z\n"
    return f"{head}element face {m}\nproperty list uchar int vertex_indices\nend_header\n{vertices}\n{faces}\n"


BROKEN = {
    "cut off.ply": ("ply\nformat ascii 1.0\nelement vert", "no line 'end_header'"),
    "no faces.ply": (_ply("0 0 0\n1 0 0\n0 1 0", "", 3, 0), "holds no faces"),
    "nan.ply": (_ply("0 0 0\n1 nan 0\n0 1 0\n0 0 1", "3 0 1 2\n3 0 1 3", 4, 2), "vertex 1 is [1.0, nan, 0.0]"),
    "flat.ply": (_ply("0 0 0\n9 0 0\n9 9 0\n0 9 0", "3 0 1 2\n3 0 2 3", 4, 2), "lie in one plane"),
    "line.stl": ("solid s\nendsolid s\n", "holds no faces"),
    "far.ply": (_ply("0 0 0\n1 0 0\n0 1 0", "3 0 1 7", 3, 1), "vertex 7"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_mesh_is_named_in_one_line(tmp_path: Path, name: str) -> None:
    content, reason = BROKEN[name]
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError) as caught:
        detect_folder(tmp_path, workers=1)
    message = str(caught.value)
    assert message.startswith(str(tmp_path / name))
    assert reason in message or name == "far.ply"
    assert "\n" not in message


@pytest.mark.parametrize(
    "content",
    [
        mesh_files.ply(mesh_files.L_PRISM.turned(2)),
        mesh_files.binary_ply(mesh_files.HEXAGON),
        mesh_files.binary_ply(mesh_files.TRIANGLES, stray=2),
        mesh_files.binary_ply(mesh_files.TRIANGLES) + b"spare",
    ],
)
def test_the_models_folder_holds_the_meshes_that_were_measured(content: bytes, tmp_path: Path) -> None:
    """Concave polygons, polygons of several sizes, points that no face uses: other readers read them otherwise."""
    cad, out = tmp_path / "cad", tmp_path / "models"
    cad.mkdir()
    (cad / "obj_000001.ply").write_bytes(content)
    detected = detect_folder(cad, workers=1)
    detected.write_models(out)
    model = load_models(out)[1]
    other = trimesh.load_mesh(out / "obj_000001.ply", process=False)
    np.testing.assert_array_equal(other.vertices, model.vertices_mm)
    np.testing.assert_array_equal(other.faces, model.faces)
    assert other.is_watertight
    assert other.bounding_box.extents.tolist() == [model.info[f"size_{axis}"] for axis in "xyz"]
    assert model.diameter_mm < 80


def test_folders_without_meshes_and_wrong_numbers(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds no meshes; files that end in \.ply"):
        detect_folder(tmp_path)
    with pytest.raises(ValueError, match="no such folder"):
        detect_folder(tmp_path / "missing")
    for wrong in ({"tolerance_percent": 0.0}, {"scale": float("nan")}):
        with pytest.raises(ValueError, match="a number above 0 is needed"):
            detect_folder(tmp_path, **wrong)


@pytest.mark.tless
def test_tless(tless_models: Path, tmp_path: Path) -> None:
    """25: BOP's axis at x = -7 mm takes one end of the plate 14 mm off it; 27: four-fold but for 0.02 %."""
    for obj_id in (25, 27):
        (tmp_path / f"obj_{obj_id:06d}.ply").symlink_to(tless_models / f"obj_{obj_id:06d}.ply")
    (tmp_path / "models_info.json").symlink_to(tless_models / "models_info.json")
    rocker, square = (o.detected for o in detect_folder(tmp_path, workers=1).objects)
    assert rocker.declared is not None
    assert rocker.declared.residual.max_mm == pytest.approx(14.0, abs=0.01)
    assert rocker.answer.group.name == "C1"
    assert rocker.next_larger is not None
    assert rocker.next_larger.group.name == "C2"
    assert rocker.next_larger.residual.max_mm == pytest.approx(13.3, abs=0.2)
    assert square.answer.group == SymmetryGroup.from_name("C4")
    assert square.answer.residual.max_mm < 0.1


@pytest.fixture
def two_boxes(tmp_path: Path) -> Path:
    """Two boxes 0.6 mm from being square prisms."""
    for obj_id in (1, 26):
        box(30, 30.6, 80).export(tmp_path / f"obj_{obj_id:06d}.ply")
    return tmp_path


def test_an_object_may_have_a_tolerance_of_its_own(two_boxes: Path, tmp_path: Path) -> None:
    table = tmp_path / "tolerances.yaml"
    table.write_text("object 26: 0.1 mm\n1: 2%")
    detected = detect_folder(two_boxes, workers=1, tolerances=parse_tolerances([str(table)]))
    assert [o.detected.answer.group.name for o in detected.objects] == ["D4", "D2"]
    assert "object 1: within 2 %\nobject 26: within 0.1 mm" in report(detected)
    assert detected.objects[1].detected.tolerance_mm == pytest.approx(0.1)
    written = parse_tolerances(["26=0.1mm", "1=2%"])
    assert written == parse_tolerances([str(table)])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["26=0.5"], "26=0.5: the tolerance '0.5' is not a number above 0 with its unit, such as 0.5mm or 2%"),
        (["26=0mm"], "not a number above 0"),
        (["26=-1mm"], "not a number above 0"),
        (["26=1e3mm"], "not a number above 0"),
        (["26=1inch"], "not a number above 0"),
        (["knob=1mm"], "'knob' names no object"),
        (["26=1mm", "026=2mm"], "object 26 has two tolerances"),
        (["none.yaml"], "none.yaml: not found"),
        (["0.5mm"], "0.5mm: not found"),
        (["7=1mm"], "object 7 has a tolerance, but .* holds objects 1, 26"),
    ],
)
def test_wrong_tolerances_are_refused_in_one_line(two_boxes: Path, given: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        detect_folder(two_boxes, workers=1, tolerances=parse_tolerances(given))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("scale", "is_asked"), [(1 / 25.4, True), (0.1, True), (1.0, False), (1e-3, False)])
def test_inches_and_centimetres_are_pointed_out(scale: float, is_asked: bool, tmp_path: Path) -> None:
    """Parts of 3 to 10 mm could be parts of 3 to 10 inches; those in metres have a warning of their own."""
    for obj_id, mesh in enumerate((box(30, 50, 80), box(60, 80, 150)), start=1):
        mesh.apply_scale(scale)
        mesh.export(tmp_path / f"obj_{obj_id:06d}.stl")
    detected = detect_folder(tmp_path, workers=1)
    text = " ".join(report(detected).split())
    assert (
        "are the units inches (--scale 25.4 turns them into millimetres) or centimetres (--scale 10)?" in text
    ) == is_asked
    assert (detected.to_json()["warning"] is not None) == is_asked
    assert ("metres?" in text) == (scale == 1e-3)
