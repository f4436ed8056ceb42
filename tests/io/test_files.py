"""Files are whole or absent, and JSON keeps every bit."""

from __future__ import annotations

import errno
import fcntl
import os
import resource
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from synthetless.io.files import (
    LockedError,
    atomic_file,
    atomic_write,
    claim,
    in_turn,
    locked,
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


def _of_another_user(folder: Path) -> None:
    if os.getuid():
        pytest.skip("only root can give a folder to another user")
    folder.mkdir(mode=0o700)
    os.chown(folder, 65534, 65534)


def _open_to_others(mode: int) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        folder.mkdir()
        folder.chmod(mode)

    return make


def _link(folder: Path) -> None:
    (folder.parent / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to("elsewhere")


def _file(folder: Path) -> None:
    folder.write_text("")


def _linked_lock(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    (folder / "optix-0.lock").symlink_to("/etc/passwd")


REFUSED: dict[str, Callable[[Path], None]] = {
    "of another user": _of_another_user,
    "readable by the group": _open_to_others(0o750),
    "writable by all": _open_to_others(0o777),
    "like the system's own": _open_to_others(0o1777),
    "passable": _open_to_others(0o711),
    "link": _link,
    "dangling link": lambda folder: folder.symlink_to("nowhere"),
    "link to itself": lambda folder: folder.symlink_to(folder),
    "file": _file,
    "pipe": os.mkfifo,
    "a lock that is a link": _linked_lock,
}


@pytest.mark.parametrize("make", REFUSED.values(), ids=REFUSED)
def test_a_number_is_claimed_in_a_folder_of_ones_own_alone(
    make: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = tmp_path / f"synthetless-{os.getuid()}"
    make(folder)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ValueError, match=rf"^{folder}.*(set TMPDIR$|symbolic links\)$)"):
        claim("optix")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("mode", [0o700, 0o2700], ids=["0700", "0700 and the group's own"])
def test_a_number_is_claimed(mode: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    _open_to_others(mode)(tmp_path / f"synthetless-{os.getuid()}")
    assert [claim("optix"), claim("optix"), claim("cuda")] == [0, 1, 0]


@pytest.mark.parametrize("fault", [errno.ENOLCK, errno.ENOTSUP, errno.EINVAL], ids=lambda fault: errno.errorcode[fault])
def test_a_file_system_without_locks_is_named(fault: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(_: int, __: int) -> None:
        raise OSError(fault, os.strerror(fault))

    monkeypatch.setattr(fcntl, "flock", flock)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    for lock in (lambda: locked(tmp_path), lambda: locked(tmp_path, "1-of-2"), lambda: in_turn(tmp_path)):
        with pytest.raises(ValueError, match="this file system cannot lock files") as caught, lock():
            pytest.fail("there is no lock")
        assert not isinstance(caught.value, LockedError), "nobody is at work there"
    with pytest.raises(ValueError, match=r"optix-0\.lock: cannot be locked"):
        claim("optix")
