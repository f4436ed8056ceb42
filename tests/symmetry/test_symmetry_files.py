"""models_info.json and symmetry tables as people write them: read, or refused in one line that says what is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synthetless.errors import UserError
from synthetless.io.models import read_models_info
from synthetless.symmetry import SymmetryGroup, SymmetryTable

HALF_TURN = np.diag([-1.0, -1, 1, 1]).ravel().tolist()
SIZES = {
    "diameter": 100.0,
    "min_x": -20.0,
    "min_y": -20.0,
    "min_z": -20.0,
    "size_x": 40.0,
    "size_y": 40.0,
    "size_z": 40.0,
}


def written(folder: Path, content: object, name: str = "models_info.json", head: bytes = b"") -> Path:
    path = folder / name
    text = content if isinstance(content, str) else json.dumps(content)
    path.write_bytes(head + text.encode())
    return path


READ = {
    "null offset": ({"symmetries_continuous": [{"axis": [0, 0, 1], "offset": None}]}, "SO(2)"),
    "no offset": ({"symmetries_continuous": [{"axis": [0, 0, 1]}]}, "SO(2)"),
    "null fields": ({"symmetries_discrete": None, "symmetries_continuous": None}, "C1"),
    "empty lists": ({"symmetries_discrete": [], "symmetries_continuous": []}, "C1"),
    "numbers as text": ({"symmetries_discrete": [[str(number) for number in HALF_TURN]]}, "C2"),
    "an axis as text": ({"symmetries_continuous": [{"axis": ["0", "0", "1"], "offset": ["0", "0", "0"]}]}, "SO(2)"),
    "nested rows": ({"symmetries_discrete": [np.reshape(HALF_TURN, (4, 4)).tolist()]}, "C2"),
    "the identity too": ({"symmetries_discrete": [np.eye(4).ravel().tolist(), HALF_TURN]}, "C2"),
    "additional keys": ({"symmetries_discrete": [HALF_TURN], "name": "knob", "colour": [1, 0, 0], "class": 3}, "C2"),
}


@pytest.mark.parametrize("case", READ)
def test_what_people_write_is_read(case: str, tmp_path: Path) -> None:
    fields, expected = READ[case]
    for name in ("models_info.json", "other_name.json"):
        path = written(tmp_path, {"7": SIZES | fields}, name)
        assert SymmetryTable.read(path).entries[7].group.name == expected


def test_a_byte_order_mark_is_no_part_of_the_file(tmp_path: Path) -> None:
    written(tmp_path, {"7": SIZES | {"symmetries_discrete": [HALF_TURN]}}, head=b"\xef\xbb\xbf")
    assert SymmetryTable.read(tmp_path).entries[7].group.name == "C2"
    assert read_models_info(tmp_path)[7]["diameter"] == 100.0
    table = written(tmp_path, "7: C3", "table.yaml", head=b"\xef\xbb\xbf")
    assert SymmetryTable.read(table).entries[7].group.name == "C3"


def test_the_diameter_is_not_needed_for_the_group(tmp_path: Path) -> None:
    for diameter in ({}, {"diameter": None}, {"diameter": "100"}, {"diameter": "large"}, {"diameter": -1}):
        path = written(tmp_path, {"7": {"symmetries_discrete": [HALF_TURN], **diameter}})
        assert SymmetryTable.read(path).entries[7].group.name == "C2"


MISSPELT = {
    "symmetry_discrete": "symmetries_discrete",
    "symmetries_discret": "symmetries_discrete",
    "symmetries_discreet": "symmetries_discrete",
    "Symmetries_Discrete": "symmetries_discrete",
    "symmetries-discrete": "symmetries_discrete",
    "symmetriesdiscrete": "symmetries_discrete",
    "discrete_symmetries": "symmetries_discrete",
    "simmetries_discrete": "symmetries_discrete",
    "symmetries_continous": "symmetries_continuous",
    "symmetry_continuous": "symmetries_continuous",
    "continuous_symmetry": "symmetries_continuous",
}


@pytest.mark.parametrize("key", MISSPELT)
def test_a_misspelt_field_is_refused_with_the_right_one(key: str, tmp_path: Path) -> None:
    """Ignored as an additional key, it would lose the symmetries without a word."""
    for name in ("models_info.json", "other_name.json"):
        path = written(tmp_path, {"7": SIZES | {key: [HALF_TURN]}}, name)
        with pytest.raises(UserError) as caught:
            SymmetryTable.read(path)
        assert str(caught.value) == f"{path}: object 7: unknown key {key!r}: did you mean {MISSPELT[key]!r}?"


@pytest.mark.parametrize("key", ["axes", "Axis", "offset_mm", "ofset"])
def test_misspelt_parts_of_a_continuous_symmetry(key: str) -> None:
    with pytest.raises(UserError, match=rf"unknown key '{key}': did you mean '(axis|offset)'"):
        SymmetryGroup.from_bop({"symmetries_continuous": [{"axis": [0, 0, 1], key: [0, 0, 1]}]})


REFUSED = {
    "a key twice": ('{"7": {"diameter": 1, "diameter": 2}}', "diameter"),
    "an object twice": ('{"7": {}, "7": {}}', "7"),
    "an object by two spellings": ('{"7": {}, "07": {}}', "object 7 is listed twice"),
    "a list": ("[1, 2]", "models_info.json maps object ids|JSON list"),
    "an entry that is a list": ('{"7": [1]}', "object 7"),
    "an entry that is null": ('{"7": null}', "object 7"),
    "an id that is a word": ('{"knob": {}}', "knob"),
    "cut off": ('{"7": {"diameter"', "models_info.json"),
    "a number": ("7", "models_info.json"),
    "empty": ("", "models_info.json"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_other_files_are_refused_in_one_line_by_both_readers(case: str, tmp_path: Path) -> None:
    text, expected = REFUSED[case]
    path = written(tmp_path, text)
    for read in (SymmetryTable.read, lambda path: read_models_info(path.parent)):
        with pytest.raises(UserError, match=expected) as caught:
            read(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


WRONG = [7, "C2", {"axis": [0, 0, 1]}, [[1, 2]], [None], [{}], [["a"] * 16], True, [HALF_TURN[:12]]]


@pytest.mark.parametrize("value", WRONG)
@pytest.mark.parametrize("field", ["symmetries_discrete", "symmetries_continuous"])
def test_a_wrong_value_names_file_object_and_key(field: str, value: object, tmp_path: Path) -> None:
    path = written(tmp_path, {"7": SIZES | {field: value}})
    with pytest.raises(UserError, match=rf"object 7: {field}") as caught:
        SymmetryTable.read(path)
    assert str(caught.value).startswith(str(path))
    assert len(str(caught.value)) < 400
    assert "\n" not in str(caught.value)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=16) | st.dictionaries(st.sampled_from(["axis", "offset", "x"]), inner),
    max_leaves=20,
)
FIELDS = st.sampled_from(["symmetries_discrete", "symmetries_continuous", "diameter", "group", "axis", "frame"])


@settings(max_examples=150, deadline=None)
@given(st.dictionaries(st.sampled_from(["1", "01", "object 2", "x"]), st.dictionaries(FIELDS, JSON, max_size=3) | JSON))
def test_whatever_a_file_holds_it_is_a_table_or_a_line(content: dict[str, object]) -> None:
    for read in (SymmetryTable.from_dict, SymmetryTable.from_models_info):
        try:
            assert isinstance(read(content), SymmetryTable)
        except UserError as error:
            assert "\n" not in str(error)
