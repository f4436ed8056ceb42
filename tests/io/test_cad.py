"""STEP and IGES files: a pin of radius 15 and length 40 with a hole of radius 4 beside its axis, written by gmsh."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from synthetless.errors import UserError
from synthetless.io.meshes import read_mesh
from synthetless.io.models import find_meshes

HERE = Path(__file__).parent
PIN = {suffix: HERE / f"pin.{suffix}" for suffix in ("step", "iges")}


@pytest.fixture
def _cascadio() -> None:
    pytest.importorskip("cascadio", reason="cascadio is not installed; extra 'cad' has it")


@pytest.mark.usefixtures("_cascadio")
@pytest.mark.parametrize("suffix", PIN)
def test_a_part_is_read_in_millimetres(suffix: str) -> None:
    mesh = read_mesh(PIN[suffix], tessellation_mm=0.01)
    assert np.allclose(mesh.vertices_mm.min(axis=0), [-15, -15, -20], atol=0.02)
    assert np.allclose(mesh.vertices_mm.max(axis=0), [15, 15, 20], atol=0.02)
    assert not mesh.is_verbatim
    if suffix == "step":  # IGES has surfaces, which need not meet
        solid = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
        assert solid.is_watertight
        assert solid.volume == pytest.approx(np.pi * (15**2 - 4**2) * 40, rel=3e-3)


@pytest.mark.usefixtures("_cascadio")
def test_the_tolerance_is_kept_and_the_same_file_gives_the_same_triangles() -> None:
    counts = []
    for tolerance_mm in (0.5, 0.1, 0.02):
        mesh = read_mesh(PIN["step"], tessellation_mm=tolerance_mm)
        middles = mesh.vertices_mm[mesh.faces].mean(axis=1)
        radius = np.hypot(middles[:, 0], middles[:, 1])
        side = (np.abs(middles[:, 2]) < 19.9) & (radius > 10)
        assert side.sum() > 20
        assert radius[side].min() >= 15 - tolerance_mm - 1e-4
        again = read_mesh(PIN["step"], tessellation_mm=tolerance_mm)
        assert np.array_equal(again.vertices_mm, mesh.vertices_mm)
        assert np.array_equal(again.faces, mesh.faces)
        counts.append(len(mesh.faces))
    assert counts == sorted(counts)
    assert counts[-1] > 2 * counts[0]


@pytest.mark.usefixtures("_cascadio")
@pytest.mark.parametrize(
    ("suffix", "change", "factor"),
    [
        ("step", ("SI_UNIT(.MILLI.,.METRE.)", "SI_UNIT($,.METRE.)"), 1000),
        ("iges", (",1.,2,2HMM,1,", ",1.,1,4HINCH,1,"), 25.4),
    ],
)
def test_the_unit_that_a_file_states_is_used(
    tmp_path: Path, suffix: str, change: tuple[str, str], factor: float
) -> None:
    text = PIN[suffix].read_text()
    assert change[0] in text
    for line in text.splitlines(keepends=True):
        if change[0] in line and suffix == "iges":  # lines of 72 columns, then a number
            text = text.replace(line, line.replace(*change).replace(" " * (len(change[1]) - len(change[0])), "", 1))
    path = tmp_path / f"pin.{suffix}"
    path.write_text(text.replace(*change))
    for scale in (1, 0.5):
        size = np.ptp(read_mesh(path, scale, tessellation_mm=0.05 * factor).vertices_mm, axis=0)
        assert np.allclose(size, scale * factor * np.array([30, 30, 40]), rtol=0.01)


@pytest.mark.usefixtures("_cascadio")
@pytest.mark.parametrize("name", ["bad.step", "bad.stp", "bad.iges", "bad.igs"])
@pytest.mark.parametrize("content", [b"", b"solid x", bytes(range(256)) * 40])
def test_what_is_no_cad_file_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=rf"{name}: (is no (STEP|IGES) file|holds no surface)"):
        read_mesh(tmp_path / name)


@pytest.mark.usefixtures("_cascadio")
def test_nothing_of_the_reader_reaches_a_command_s_answer() -> None:
    code = (
        "import sys, json\nfrom pathlib import Path\nfrom synthetless.io.meshes import read_mesh\n"
        "print('[', end='')\n"
        "mesh = read_mesh(Path(sys.argv[1]))\n"
        "print(json.dumps(len(mesh.faces)) + ']')\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(PIN["iges"])], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)[0] > 50
    assert done.stderr == ""


def test_without_the_package_one_line_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cascadio", None)
    with pytest.raises(UserError, match=r"pin\.step: CAD files need the package cascadio; .*\[cad\]'.* or convert"):
        read_mesh(PIN["step"])


def test_cad_files_are_found_and_give_their_names(tmp_path: Path) -> None:
    for name in ("bolt.STP", "angle.igs", "pin.step"):
        (tmp_path / name).touch()
    assert [path.name for path in find_meshes(tmp_path).paths.values()] == ["angle.igs", "bolt.STP", "pin.step"]
