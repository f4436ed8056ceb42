"""Models folders: what a good one gives, and the one line that each kind of bad one is answered with."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import TRIANGLES, binary_ply

from synthetless.errors import UserError
from synthetless.io.models import load_models


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two boxes with a true models_info.json."""
    infos = {}
    for obj_id, size in ((1, (30.0, 20.0, 10.0)), (2, (40.0, 40.0, 5.0))):
        box = trimesh.creation.box(size)
        box.export(tmp_path / f"obj_{obj_id:06d}.ply")
        info = {"diameter": float(np.linalg.norm(size))}
        for axis, side in zip("xyz", size, strict=True):
            info |= {f"min_{axis}": -side / 2, f"size_{axis}": side}
        infos[str(obj_id)] = info
    (tmp_path / "models_info.json").write_text(json.dumps(infos))
    return tmp_path


def test_models_are_read_in_millimetres(folder: Path) -> None:
    models = load_models(folder)
    assert list(models) == [1, 2]
    assert models[1].diameter_mm == pytest.approx(np.sqrt(1400))
    np.testing.assert_allclose(np.ptp(models[1].vertices_mm, axis=0), [30, 20, 10])
    assert models[1].faces.shape == (12, 3)
    assert models[1].digest != models[2].digest
    assert list(load_models(folder, (2,))) == [2]


def _edit_info(folder: Path, edit: Callable[[dict[str, dict[str, object]]], object]) -> None:
    path = folder / "models_info.json"
    infos = json.loads(path.read_text())
    edit(infos)
    path.write_text(json.dumps(infos))


def _write_ply(folder: Path, vertices: str, faces: str) -> None:
    count = (len(vertices.split("|")), len(faces.split("|")) if faces else 0)
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {count[0]}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {count[1]}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    body = "\n".join([*vertices.split("|"), *(faces.split("|") if faces else [])])
    (folder / "obj_000001.ply").write_text(f"{header}{body}\n")


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "empty file": (lambda f: (f / "obj_000001.ply").write_bytes(b""), "obj_000001.ply"),
    "garbage": (lambda f: (f / "obj_000001.ply").write_bytes(b"\x00\x01garbage" * 50), "obj_000001.ply"),
    "cut off": (
        lambda f: (f / "obj_000001.ply").write_bytes((f / "obj_000001.ply").read_bytes()[:400]),
        "obj_000001.ply",
    ),
    "no faces": (lambda f: _write_ply(f, "0 0 0|1 0 0|0 1 0", ""), "holds no faces"),
    "nan": (lambda f: _write_ply(f, "0 0 nan|1 0 0|0 1 0", "3 0 1 2"), "vertex 0"),
    "face beyond the vertices": (lambda f: _write_ply(f, "0 0 0|1 0 0|0 1 0", "3 0 1 7"), "obj_000001.ply"),
    "no info": (lambda f: (f / "models_info.json").unlink(), "models_info.json: not found"),
    "info is no json": (lambda f: (f / "models_info.json").write_text('{"1": '), "models_info.json: not valid JSON"),
    "info is a list": (lambda f: (f / "models_info.json").write_text("[1, 2]"), "models_info.json: holds a JSON list"),
    "object without info": (lambda f: _edit_info(f, lambda i: i.pop("2")), "no entry for object 2"),
    "no diameter": (lambda f: _edit_info(f, lambda i: i["1"].pop("diameter")), "object 1 has diameter None"),
    "negative diameter": (lambda f: _edit_info(f, lambda i: i["1"].update(diameter=-3)), "diameter -3"),
    "diameter is text": (lambda f: _edit_info(f, lambda i: i["1"].update(diameter="37")), "diameter '37'"),
    "huge diameter": (lambda f: _edit_info(f, lambda i: i["1"].update(diameter=10**400)), "object 1 has diameter 1000"),
    "box is a list": (lambda f: _edit_info(f, lambda i: i["1"].update(size_x=[30])), "object 1 has size_x [30]"),
    "box is a mapping": (lambda f: _edit_info(f, lambda i: i["2"].update(size_z={})), "object 2 has size_z {}"),
    "box is text": (lambda f: _edit_info(f, lambda i: i["1"].update(size_x="30")), "object 1 has size_x '30'"),
    "box is not finite": (lambda f: _edit_info(f, lambda i: i["1"].update(size_x=float("nan"))), "size_x nan"),
    "deep info": (lambda f: (f / "models_info.json").write_text("[" * 100_000), "is nested too deeply"),
    "metres": (lambda f: _edit_info(f, lambda i: i["1"].update(size_x=0.03)), "are its units millimetres"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_bad_folder_is_told_in_one_line(folder: Path, kind: str) -> None:
    damage, expected = DAMAGE[kind]
    damage(folder)
    with pytest.raises(UserError) as error:
        load_models(folder)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_or_empty_folder_is_told(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such models folder"):
        load_models(tmp_path / "none")
    with pytest.raises(UserError, match="holds no models"):
        load_models(tmp_path)


def test_an_unknown_object_is_told(folder: Path) -> None:
    with pytest.raises(UserError, match="no mesh for object 9; the folder holds objects 1, 2"):
        load_models(folder, (9,))


def test_points_that_no_face_uses_do_not_count(folder: Path) -> None:
    """The box of the others is the one that models_info.json states, and a dataset carries a mesh without them."""
    path = folder / "obj_000001.ply"
    path.write_bytes(binary_ply(TRIANGLES, stray=3))
    model = load_models(folder)[1]
    np.testing.assert_array_equal(np.ptp(model.vertices_mm, axis=0), [30, 20, 10])
    np.testing.assert_array_equal(np.ptp(model.box_corners_mm, axis=0), [30, 20, 10])
    path.write_bytes(model.to_ply())
    again = load_models(folder)[1]
    np.testing.assert_array_equal(again.vertices_mm, model.vertices_mm)
    np.testing.assert_array_equal(again.faces, model.faces)
    assert again.digest == model.digest


def test_a_dataset_carries_the_file_itself_where_it_is_the_mesh(folder: Path) -> None:
    model = load_models(folder)[1]
    assert model.to_ply() == model.path.read_bytes()


@pytest.mark.tless
def test_the_real_models_load(tless_models: Path) -> None:
    models = load_models(tless_models)
    assert list(models) == list(range(1, 31))
    for model in models.values():
        hull = trimesh.convex.hull_points(model.vertices_mm)
        farthest = max(np.linalg.norm(hull - point, axis=1).max() for point in hull[:: max(1, len(hull) // 200)])
        assert farthest <= model.diameter_mm * 1.001
