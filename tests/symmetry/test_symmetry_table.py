"""The symmetry table: as a person writes it, as a dataset keeps it, and what it refuses."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from symmetry_cases import ALL, SCHEMES, in_random_frame, random_rotations, seeds

from synthetless.errors import UserError
from synthetless.symmetry import QuasiSymmetry, SymmetryEntry, SymmetryGroup, SymmetryTable
from synthetless.symmetry.detection.report import describe
from synthetless.symmetry.quaternions import from_matrix, multiply, to_matrix

BY_HAND = """
object 26: {group: C2, axis: [0, 0, 1], offset: [-7, 0, 0]}
27: {group: C4}
"obj_000028": C1
object 3:
  group: D3
  axis: [0, 1, 0]
  secondary_axis: [1, 0, 0]
  reference_rotation: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
"""


def read(tmp_path: Path, text: str) -> SymmetryTable:
    path = tmp_path / "symmetries.yaml"
    path.write_text(text)
    return SymmetryTable.read(path)


def test_a_table_written_by_hand(tmp_path: Path) -> None:
    table = read(tmp_path, BY_HAND)
    assert list(table.entries) == [3, 26, 27, 28]
    assert table.scheme == "pitteri2019"
    assert table.entries[26].group == SymmetryGroup.from_name("C2", axis=(0, 0, 1), offset_mm=(-7, 0, 0))
    assert table.entries[27].group.name == "C4"
    assert table.entries[28].group == SymmetryGroup.trivial()
    assert table.entries[3].reference_rotation == ((0, -1, 0), (1, 0, 0), (0, 0, 1))
    np.testing.assert_allclose(np.abs(table.canonical_map(3).anchors_wxyz[0]), [0.5**0.5, 0, 0, 0.5**0.5])
    shared = "1: &box {group: D2}\n2: {<<: *box, group: D4}"
    assert [entry.group.name for entry in read(tmp_path, shared).entries.values()] == ["D2", "D4"]
    assert read(tmp_path, "scheme: atlas\nobjects: {1: {group: SO(2)}}").canonical_map(1).n_regressors == 2


@settings(max_examples=15, deadline=None)
@given(seed=seeds)
def test_the_file_gives_the_table_back_exactly(seed: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    rng = np.random.default_rng(seed)
    references = [None if i % 2 else tuple(map(tuple, random_rotations(rng, 1)[0].tolist())) for i in range(len(ALL))]
    entries = {i + 1: SymmetryEntry(in_random_frame(name, rng), references[i]) for i, name in enumerate(ALL)}
    table = SymmetryTable(entries, SCHEMES[seed % 2], bool(seed % 3), decimals=4 + seed % 12)
    path = tmp_path_factory.mktemp("table") / "symmetries.json"
    table.write(path)
    first = path.read_bytes()
    back = SymmetryTable.read(path)
    assert back == table
    assert back.digest() == table.digest()
    back.write(path)
    assert path.read_bytes() == first
    assert list(path.parent.iterdir()) == [path]
    for obj_id in entries:
        np.testing.assert_array_equal(back.canonical_map(obj_id).anchors_wxyz, table.canonical_map(obj_id).anchors_wxyz)


def test_what_the_file_says() -> None:
    table = SymmetryTable({26: SymmetryEntry(SymmetryGroup.from_name("C2", offset_mm=(-7, 0, 0)))}, "atlas")
    entry = table.to_dict()["objects"]["26"]
    assert entry["group"] == "C2"
    assert entry["axis"] == [0, 0, 1]
    assert entry["offset_mm"] == [-7, 0, 0]
    assert (entry["order"], entry["n_regressors"]) == (2, 4)
    assert entry["separation_deg"] == pytest.approx(62.8, abs=0.01)
    np.testing.assert_allclose(
        entry["anchors"],
        [[1, 0, 0, 0], [0.5**0.5, 0, 0, 0.5**0.5], [0, 1, 0, 0], [0, 0.5**0.5, -(0.5**0.5), 0]],
        atol=1e-12,
    )


def test_only_rounded_poses_are_worth_a_key(tmp_path: Path) -> None:
    table = SymmetryTable({1: SymmetryEntry(SymmetryGroup.from_name("C3"))})
    assert "decimals" not in table.to_dict()
    replace(table, decimals=6).write(tmp_path / "symmetries.json")
    assert json.loads((tmp_path / "symmetries.json").read_text())["decimals"] == 6
    read = SymmetryTable.read(tmp_path / "symmetries.json")
    assert (read.decimals, read.canonical_map(1).decimals) == (6, 6)


def test_digests_tell_tables_apart() -> None:
    def table(name: str, scheme: str = "pitteri2019", allocentric: bool = False) -> SymmetryTable:
        return SymmetryTable({1: SymmetryEntry(SymmetryGroup.from_name(name))}, scheme, allocentric)

    tables = [table("C2"), table("C3"), table("C2", "atlas"), table("C2", allocentric=True)]
    tables += [replace(table("C2"), decimals=6)]
    assert len({t.digest() for t in tables}) == 5
    assert table("C2").digest() == tables[0].digest()


@pytest.mark.parametrize("name", ["D2", "D3"])
def test_a_table_of_an_earlier_version_is_read_and_has_another_digest(name: str, tmp_path: Path) -> None:
    """Its D_n had the fourth anchor of `pitteri2019` in another class: the labels are stale, the groups are right."""
    group = in_random_frame(name, np.random.default_rng(0))
    table = SymmetryTable({5: SymmetryEntry(group)})
    former = table.to_dict()
    anchors = from_matrix(to_matrix(np.array(former["objects"]["5"]["anchors"])))
    anchors[3] = multiply(anchors[2], anchors[1])
    former["objects"]["5"] |= {"anchors": anchors.tolist(), "separation_deg": 0.0}
    path = tmp_path / "symmetries.json"
    path.write_text(json.dumps(former))
    assert SymmetryTable.read(path) == table
    former["objects"]["5"]["anchors"][3] = anchors[2].tolist()
    path.write_text(json.dumps(former))
    with pytest.raises(ValueError, match="anchors does not follow"):
        SymmetryTable.read(path)


def test_tless_models_info_is_a_table_too(tless_models: Path) -> None:
    path = tless_models / "models_info.json"
    table = SymmetryTable.from_models_info(json.loads(path.read_text()), "atlas")
    assert list(table.entries) == list(range(1, 31))
    assert dict(table.entries) == dict(SymmetryTable.read(path).entries)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("26: {group: C2, axes: [0, 0, 1]}", "object 26: it has the unknown key 'axes': did you mean 'axis'"),
        ("26: {group: c2}", "object 26: unknown symmetry group 'c2': did you mean 'C2'"),
        ("26: {group: C0}", "order 0"),
        ("26: {group: C2, axis: [0, 0, 0]}", "object 26: C2: axis is zero"),
        ("26: {group: C2, offset: [1, 2]}", "not 3 finite numbers"),
        ("26: {group: C2, offset: [1, 2, 3], offset_mm: [1, 2, 3]}", "give one of them"),
        ("26: {axis: [0, 0, 1]}", "no group"),
        ("26: 7", "describes no symmetries"),
        ("26: {group: C2, reference_rotation: [1, 0, 0, 0, 1, 0, 0, 0, -1]}", "reflection"),
        ("26: {group: C2, reference_rotation: [1, 0, 0]}", "3 rows of 3"),
        ("26: {group: D3, frame: [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}", "reflection"),
        ("26: {group: C2, order: 3}", "order does not follow"),
        ("26: {group: C2, anchors: [[1, 0, 0, 0]]}", "anchors does not follow"),
        ("26: {symmetries_discrete: [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]]}", "object 26: .*reflection"),
        ("26: {group: C2}\nobject 26: {group: C3}", "object 26 is listed twice"),
        ("26: {group: C2}\n26: {group: C3}", "'26' is listed twice"),
        ('{"26": {"group": "C2"}, "26": {"group": "C3"}}', 'key "26" occurs twice'),
        ("26: {group: C2, group: C3}", "'group' is listed twice"),
        ("26: {}", "no group"),
        ("widget: {group: C2}", "'widget' names no object"),
        ("schema: atlas", "did you mean 'scheme'"),
        ("scheme: pitteri\nobjects: {}", "unknown scheme 'pitteri'"),
        ("allocentric: maybe\nobjects: {}", "allocentric is 'maybe'"),
        ("decimals: 2\nobjects: {}", "decimals is 2, not a whole number from 4 to 15"),
        ("objects: [1]", "not a mapping"),
        ("[1, 2]", "is a mapping"),
        ("a: [", "neither JSON nor YAML"),
        ('{"objects": {"26": {"group": "C2"', "neither JSON nor YAML"),
    ],
)
def test_wrong_tables_are_refused_in_one_line_with_the_file(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        read(tmp_path, text)
    assert "symmetries.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_and_objects_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.json: not found"):
        SymmetryTable.read(tmp_path / "none.json")
    with pytest.raises(ValueError, match="object 5 is not in the symmetry table, which has objects 26"):
        SymmetryTable({26: SymmetryEntry(SymmetryGroup.trivial())}).canonical_map(5)


QUASI = """
1: {group: C1, quasi: {group: SO(2), axis: [0, 0, 1], offset: [-7, 0, 0], tolerance_mm: 2}}
2: {group: C2, axis: [0, 0, 1], quasi: C4}
3: {group: C2, axis: [1, 0, 0], quasi: {group: O(2), axis: [0, 0, 1]}}
4: {group: SO(2), quasi: O(2)}
5: {group: D2, quasi: O}
6: {group: SO(2), axis: [0, 1, 0], quasi: SO(3)}
7: {group: C3}
"""


def test_a_larger_group_that_an_object_nearly_has(tmp_path: Path) -> None:
    table = read(tmp_path, QUASI)
    quasi = table.entries[1].quasi
    assert quasi == QuasiSymmetry(SymmetryGroup.from_name("SO(2)", offset_mm=(-7, 0, 0)), 2.0)
    assert table.entries[7].quasi is None
    table.write(tmp_path / "symmetries.json")
    back = SymmetryTable.read(tmp_path / "symmetries.json")
    assert back == table and back.digest() == table.digest()
    assert "object 1: SO(2), axis z, fixed point (-7 0 0), but for a detail of at most 2 mm" in describe(table)
    assert "quasi" not in describe(SymmetryTable({7: table.entries[7]}))


def test_tables_without_quasi_symmetries_keep_their_bytes_and_digest() -> None:
    entry = SymmetryEntry(SymmetryGroup.from_name("C2", offset_mm=(-7, 0, 0)))
    table = SymmetryTable({26: entry})
    assert "quasi" not in table.to_dict()["objects"]["26"]
    assert table.digest() == "fbeedff75d4fb898d2d28b70f096f404bb7b3eb4944262ea635973bac1f0c856"
    larger = replace(entry, quasi=QuasiSymmetry(SymmetryGroup.from_name("C4", offset_mm=(-7, 0, 0))))
    assert SymmetryTable({26: larger}).digest() != table.digest()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1: {group: C3, quasi: C4}", "does not contain the group C3"),
        ("1: {group: C2, axis: [1, 0, 0], quasi: C4}", "about the same axis"),
        ("1: {group: C2, offset: [-7, 0, 0], quasi: C4}", "C2 about [0.0, 0.0, 1.0] through [-7.0, 0.0, 0.0]"),
        ("1: {group: SO(2), quasi: C12}", "does not contain"),
        ("1: {group: SO(2), quasi: {group: O(2), axis: [1, 0, 0]}}", "does not contain"),
        ("1: {group: SO(3), quasi: O(2)}", "does not contain"),
        ("1: {group: C4, quasi: C4}", "the group itself"),
        ("1: {group: O(2), quasi: O(2)}", "the group itself"),
        ("1: {group: C1, quasi: {axis: [0, 0, 1]}}", "quasi: it has no group"),
        ("1: {group: C1, quasi: {group: C0}}", "quasi: "),
        ("1: {group: C1, quasi: {group: C2, tolerance: 2}}", "did you mean 'tolerance_mm'"),
        ("1: {group: C1, quasi: {group: C2, tolerance_mm: 0}}", "tolerance_mm of quasi is 0"),
        ("1: {group: C1, quasi: {group: C2, tolerance_mm: true}}", "tolerance_mm of quasi is True"),
        ("1: {group: C1, quasi: {group: C2, tolerance_mm: .nan}}", "tolerance_mm of quasi is nan"),
        ("1: {group: C1, quasi: [C2]}", "quasi is ['C2']"),
        ("1: {group: C1, quasi: {group: C2, quasi: C4}}", "quasi has the unknown key 'quasi'"),
    ],
)
def test_quasi_symmetries_that_are_refused(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=re.escape(message)) as caught:
        read(tmp_path, text)
    assert "object 1: " in str(caught.value)


def test_every_group_contains_exactly_its_subgroups() -> None:
    named = {name: SymmetryGroup.from_name(name) for name in ("C1", "C2", "C3", "C4", "C6", "C7", "D2", "D3", "T", "O")}
    named |= {name: SymmetryGroup.from_name(name) for name in ("SO(2)", "O(2)", "SO(3)")}
    chains = {
        "C4": {"C2"}, "C6": {"C2", "C3"}, "D2": {"C2"}, "D3": {"C3"}, "T": {"C2", "D2"},
        "O": {"C2", "C4", "D2", "T"}, "SO(2)": {"C2", "C3", "C4", "C6", "C7"},
        "O(2)": {"C2", "C3", "C4", "C6", "C7", "D2", "D3", "SO(2)"}, "SO(3)": set(named),
    }  # fmt: skip
    for large, group in named.items():
        contained = {small for small, other in named.items() if group.contains(other)}
        assert contained == {"C1", large} | chains.get(large, set()), large
