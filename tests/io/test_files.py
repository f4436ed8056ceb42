"""Files are whole or absent, and JSON keeps every bit."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from synthetless.io.files import (
    atomic_file,
    atomic_write,
    read_json,
    read_json_lines,
    write_json,
    write_json_lines,
)

finite = st.floats(allow_nan=False, allow_infinity=False)


def test_an_interrupted_write_leaves_the_old_file_and_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    atomic_write(path, b"old")
    with pytest.raises(KeyboardInterrupt), atomic_file(path) as file:
        file.write(b"half of the n")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_parent_folders_are_made(tmp_path: Path) -> None:
    atomic_write(tmp_path / "a" / "b" / "c.bin", b"x", durable=True)
    assert (tmp_path / "a" / "b" / "c.bin").read_bytes() == b"x"


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ValueError, match=r"file/x\.bin: cannot be written \(File exists\)"):
        atomic_write(tmp_path / "file" / "x.bin", b"")


def test_a_disk_that_takes_no_more_leaves_nothing_half_written(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(ValueError, match=r"x\.bin: cannot be written \(File too large\)"):
            atomic_write(tmp_path / "x.bin", bytes(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not any(tmp_path.iterdir())


@given(values=st.dictionaries(st.text(max_size=5), st.lists(finite, max_size=4), max_size=5))
def test_json_round_trip_is_exact(tmp_path_factory: pytest.TempPathFactory, values: dict[str, list[float]]) -> None:
    path = tmp_path_factory.mktemp("json") / "a.json"
    write_json(path, values)
    back = read_json(path)
    assert list(back) == list(values)
    assert all([v.hex() for v in back[key]] == [v.hex() for v in values[key]] for key in values)
    assert path.read_bytes().count(b"\n") == 2 + max(1, len(values))


@given(records=st.lists(st.lists(finite, max_size=3), max_size=5))
def test_json_lines_round_trip(tmp_path_factory: pytest.TempPathFactory, records: list[list[float]]) -> None:
    path = tmp_path_factory.mktemp("jsonl") / "a.jsonl"
    write_json_lines(path, records)
    assert read_json_lines(path) == records


def test_a_number_that_is_not_finite_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a\.json: not written, a number in it is not finite"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b'{"0": [1, 2', "not valid JSON, cut off or damaged"),
        (b"", "not valid JSON"),
        (b"\xff\xfe\x00", "not valid JSON"),
        (b'{"0": 1, "0": 2}', 'key "0" occurs twice'),
        (b"[1]", "holds a JSON list; an object is needed"),
    ],
)
def test_damaged_json_is_one_line_that_names_the_file(tmp_path: Path, content: bytes, complaint: str) -> None:
    path = tmp_path / "scene_gt.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=complaint) as caught:
        read_json(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_missing_files_and_broken_lines_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.json: not found"):
        read_json(tmp_path / "none.json")
    path = tmp_path / "a.jsonl"
    path.write_text('{"a": 1}\n{"a": \n')
    with pytest.raises(ValueError, match=r"a\.jsonl, line 2: not valid JSON"):
        read_json_lines(path)
