"""docs/symmetry.md says what the code does: its figures, its examples and its numbers."""

from __future__ import annotations

import doctest
import re

import numpy as np
import pytest
import yaml

pytest.importorskip("matplotlib", reason="the figures need matplotlib, extra 'preview'")
import cv2
from scipy.spatial import cKDTree

from docs.figures import make
from synthetless.symmetry import CanonicalMap, SymmetryGroup, SymmetryTable
from synthetless.symmetry.atlas import NO_JUMP_DEG, SCHEMES

PAGE = (make.ROOT / "docs" / "symmetry.md").read_text(encoding="utf-8")
CYCLIC = [f"C{n}" for n in range(1, 7)]
DIHEDRAL = [f"D{n}" for n in range(2, 7)]
ROWS = re.findall(r"^\| (\S+) \| (\d+|inf) \| (\d+) \| (.+?) \| (\d+) \| (.+?) \|$", PAGE, re.MULTILINE)


def _blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def _decoded(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image.astype(np.float64)


def test_the_figures_are_what_the_script_makes() -> None:
    for name, content in make.figures():
        committed = (make.IMAGES / name).read_bytes()
        if name.endswith(".svg"):
            assert content == committed, name
        else:
            made, shown = _decoded(content), _decoded(committed)
            assert made.shape == shown.shape and np.abs(made - shown).mean() < 0.5, name


def test_the_page_shows_every_figure_and_links_only_to_files() -> None:
    targets = set(re.findall(r"\]\((?!https?:)([^)]+)\)", PAGE))
    assert {f"images/{name}" for name in make.FIGURES} == {target for target in targets if target.startswith("images/")}
    assert all((make.ROOT / "docs" / target).is_file() for target in targets)


def test_the_examples_run_and_print_what_the_page_says() -> None:
    text = "\n".join(_blocks("pycon"))
    examples = doctest.DocTestParser().get_doctest(text, {}, "docs/symmetry.md", "docs/symmetry.md", 0)
    assert len(examples.examples) > 10
    assert doctest.DocTestRunner().run(examples).failed == 0


def test_the_table_by_hand_is_one() -> None:
    exact, almost = (SymmetryTable.from_dict(yaml.safe_load(text)).entries for text in _blocks("yaml"))
    assert {obj_id: entry.group.name for obj_id, entry in exact.items()} == {26: "C2", 27: "C4", 31: "D2"}
    quasi = almost[14].quasi
    assert quasi is not None and (quasi.group.name, quasi.tolerance_mm) == ("SO(2)", 2.0)


@pytest.mark.parametrize("obj_id", [26, 27])
def test_the_parts_of_the_picture_look_the_same_in_all_their_poses(obj_id: int) -> None:
    part = make.load_models(make.ROOT / "assets" / "parts", (obj_id,))[obj_id]
    vertices = part.vertices_mm
    for motion in SymmetryGroup.from_bop(part.info).motions():
        assert cKDTree(vertices).query(vertices @ motion[:3, :3].T + motion[:3, 3])[0].max() < 1e-3


def test_the_page_lists_every_kind_of_group() -> None:
    assert [row[0] for row in ROWS] == [*CYCLIC, *DIHEDRAL, "T", "O", "I", "SO(2)", "O(2)", "SO(3)"]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_the_margins_are_those_of_the_code(row: tuple[str, ...]) -> None:
    group = SymmetryGroup.from_name(row[0])
    assert float(row[1]) == group.order
    for scheme, n_regressors, margin in zip(SCHEMES, row[2::2], row[3::2], strict=True):
        canonical = CanonicalMap(group, scheme)
        assert canonical.n_regressors == int(n_regressors)
        expected = NO_JUMP_DEG if margin == "no jump" else float(margin)
        assert canonical.smallest_margin_deg == pytest.approx(expected, abs=0.005)


def test_the_smallest_margin_by_tilt_is_the_formula() -> None:
    tilt = np.linspace(0, 179, 12)
    formula = np.degrees(2 * np.arcsin(np.cos(np.radians(tilt) / 2) * np.sin(np.pi / 8)))
    np.testing.assert_allclose(make.smallest_margin_at_tilt(tilt, "pitteri2019"), formula, atol=1e-3)
    mirrored = np.where(tilt <= 90, formula, make.smallest_margin_at_tilt(180 - tilt, "pitteri2019"))
    np.testing.assert_allclose(make.smallest_margin_at_tilt(tilt, "atlas"), mirrored, atol=1e-3)


@pytest.mark.parametrize(("regressor", "nearest_deg"), [(0, 6.1), (1, 2.5)])
def test_near_poses_of_the_path_have_labels_half_a_turn_apart(regressor: int, nearest_deg: float) -> None:
    s = np.linspace(-25, 25, 1001)
    R = make.tilts_through_top_down(s)
    found = make.labels(R, "pitteri2019")
    R, R_c = (rotations[found.regressor_index == regressor] for rotations in (R, found.R_m2c))
    torn = make.apart_deg(R_c[:, None], R_c[None]) > 90
    i, j = np.nonzero(torn)
    assert make.C2.appearance_distance_deg(R[i], R[j]).min() == pytest.approx(nearest_deg, abs=0.06)
    assert make.apart_deg(R_c[i], R_c[j]).min() > 120


def test_the_atlas_follows_the_appearance_along_the_path() -> None:
    R = make.tilts_through_top_down(np.linspace(-25, 25, 101))
    found = make.labels(R, "atlas")
    assert set(found.regressor_index) == {2}
    appearance = make.C2.appearance_distance_deg(R, np.tile(R[0], (len(R), 1, 1)))
    np.testing.assert_allclose(make.apart_deg(found.R_m2c, found.R_m2c[0]), appearance, atol=1e-6)


def test_a_reference_seen_from_above_moves_the_bad_view_below() -> None:
    in_plane = make.turn("z", np.linspace(0, 360, 73))
    t = np.zeros((73, 3))
    canonical = CanonicalMap(make.C2, "pitteri2019", reference_rotation=np.diag([1.0, -1.0, -1.0]))
    assert canonical(in_plane @ make.turn("x", 180.0), t).discontinuity_margin_deg.min() > 44
    assert canonical(in_plane @ make.turn("x", 0.1), t).discontinuity_margin_deg.min() < 0.1
