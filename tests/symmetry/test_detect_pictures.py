"""Pictures: the part, its axis and its residual are where they belong."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from detect_shapes import box, prism
from notch import Notched
from numpy.typing import NDArray

from synthetless.io.meshes import TriangleMesh
from synthetless.symmetry import SymmetryGroup, SymmetryTable
from synthetless.symmetry.detection.detect import measure
from synthetless.symmetry.detection.pictures import draw_table, picture, views_left_open
from synthetless.symmetry.table import QuasiSymmetry, SymmetryEntry

VIEWS_PX, HEAD_PX = 1200, 34


def drawn(mesh: TriangleMesh, *groups: SymmetryGroup) -> NDArray[np.uint8]:
    fits = [measure(mesh.vertices_mm, mesh.faces, mesh.diameter_mm, group) for group in groups]
    return picture("object 1", mesh, fits, 0.01 * mesh.diameter_mm)


def mesh_of(x: float, y: float, z: float) -> TriangleMesh:
    part = box(x, y, z)
    return TriangleMesh(np.asarray(part.vertices), np.asarray(part.faces), is_verbatim=False)


def saturation(image: NDArray[np.uint8]) -> NDArray[np.int_]:
    views = image[HEAD_PX:, :VIEWS_PX].astype(int)
    return views.max(axis=2) - views.min(axis=2)


def test_a_perfect_group_is_grey_and_a_wrong_one_is_coloured() -> None:
    image = drawn(mesh_of(30, 50, 80), SymmetryGroup.trivial(), SymmetryGroup.from_name("D4"))
    right, wrong = np.split(image, 2)
    part = (right[HEAD_PX:, :VIEWS_PX] != 255).any(axis=2)
    assert 0.2 < part.mean() < 0.6
    assert (saturation(right)[part] > 60).mean() < 0.02  # only the little model frame has colours
    assert (saturation(wrong)[part] > 60).mean() > 0.2


def test_the_axis_goes_through_the_fixed_point() -> None:
    """Seen from x = 1, y = -1.4, z = 0.8 the axis z is upright, and moves right with a fixed point further to x."""
    columns = []
    for x in (0.0, 12.0):
        left = drawn(mesh_of(30, 50, 80), SymmetryGroup.from_name("C2", offset_mm=(x, 0, 0)))[HEAD_PX:, :400]
        red = (left == (210, 20, 20)).all(axis=2)
        assert red.any(axis=1).mean() > 0.3
        spread = np.flatnonzero(red.any(axis=0))
        assert np.ptp(spread) <= 10  # perspective tilts it a little
        columns.append(float(spread.mean()))
    assert columns[0] == pytest.approx(200, abs=2)
    assert columns[1] > 225


def test_tables_are_drawn_for_the_meshes_that_are_there(tmp_path: Path) -> None:
    prism(6).export(tmp_path / "obj_000002.ply")
    table = SymmetryTable({k: SymmetryEntry(SymmetryGroup.from_name("D6")) for k in (2, 9)})
    draw_table(table, tmp_path, tmp_path / "pictures", workers=1)
    (path,) = (tmp_path / "pictures").iterdir()
    assert path.name == "obj_000002.png"
    assert cv2.imread(str(path)).shape == (434, 1320, 3)
    with pytest.raises(ValueError, match="holds none of the table's objects, 9"):
        draw_table(SymmetryTable({9: table.entries[9]}), tmp_path, tmp_path / "pictures")


def test_a_quasi_symmetry_is_drawn_below_with_the_detail_coloured(tmp_path: Path) -> None:
    """A box that is not square is coloured where a quarter turn misses it."""
    box(30, 38, 80).export(tmp_path / "obj_000001.ply")
    exact, larger = SymmetryGroup.from_name("D2"), SymmetryGroup.from_name("D4")
    table = SymmetryTable({1: SymmetryEntry(exact, quasi=QuasiSymmetry(larger, 6.0))})
    draw_table(table, tmp_path, tmp_path / "pictures", workers=1)
    image = cv2.imread(str(tmp_path / "pictures" / "obj_000001.png"))
    assert image is not None
    assert image.shape == (2 * 434 + 322, 1320, 3)
    upper, lower = (saturation(half[..., ::-1].astype(np.uint8)) for half in np.split(image[: 2 * 434], 2))
    assert (upper > 60).mean() < 0.02
    assert (lower > 60).mean() > 0.1


def test_the_views_that_hide_a_notch_are_those_from_behind() -> None:
    """The notch is towards x: the middle of the map tells it, and both its ends, the back, do not."""
    vertices, faces = Notched(depth_mm=4.0, half_width_deg=20.0).mesh(3.0)
    mesh = TriangleMesh(vertices, faces, is_verbatim=False)
    image = views_left_open(mesh, SymmetryGroup.trivial(), SymmetryGroup.from_name("C4"), VIEWS_PX)
    middle = image[HEAD_PX + 24 + 120, 24 : 24 + 480].astype(int)
    told = middle.max(axis=1) - middle.min(axis=1)
    assert told[200:280].max() < 60 <= min(told[10:30].max(), told[450:470].max())
    sky = image[HEAD_PX + 24 + 10 : HEAD_PX + 24 + 60, 24 + 200 : 24 + 280].astype(int)  # from above the rim shows it
    assert np.ptp(sky, axis=2).max() < 60
