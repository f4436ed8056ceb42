"""Computed once, kept on disk: never wrong, never in the way."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from synthetless.io.cache import CACHE_VARIABLE, Cache, digest

KEY = "ab" * 32


class Computation:
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, NDArray[Any]]:
        self.calls += 1
        return {
            "points": np.linspace(0, 1, 30).reshape(10, 3).T,  # not C-contiguous
            "faces": np.arange(6, dtype=np.int32).reshape(2, 3),
            "volume": np.array(0.1 + 0.2),
            "empty": np.zeros((0, 3)),
            "special": np.array([np.nan, -0.0, np.inf], dtype=np.float32),
        }


@pytest.fixture
def compute() -> Computation:
    return Computation()


def _same(one: dict[str, NDArray[Any]], other: dict[str, NDArray[Any]]) -> bool:
    return one.keys() == other.keys() and all(
        (a.dtype, a.shape, a.flags.c_contiguous, a.tobytes()) == (b.dtype, b.shape, b.flags.c_contiguous, b.tobytes())
        for a, b in ((one[name], other[name]) for name in one)
    )


def _file(folder: Path) -> Path:
    (path,) = (path for path in folder.rglob("*") if path.is_file())
    return path


def test_what_is_read_is_what_was_computed_bit_for_bit(tmp_path: Path, compute: Computation) -> None:
    without = Cache(None).arrays("thing", KEY, "1", compute)
    computed = Cache(tmp_path).arrays("thing", KEY, "1", compute)
    read = Cache(tmp_path).arrays("thing", KEY, "1", compute)
    assert compute.calls == 2
    assert _same(without, computed)
    assert _same(without, read)
    read["points"][:] = 7  # the caller's own
    assert _same(without, Cache(tmp_path).arrays("thing", KEY, "1", compute))


def test_kind_key_and_version_are_told_apart(tmp_path: Path, compute: Computation) -> None:
    for kind, key, version in (
        ("thing", KEY, "1"),
        ("other", KEY, "1"),
        ("thing", KEY, "2"),
        ("thing", "cd" * 32, "1"),
    ):
        Cache(tmp_path).arrays(kind, key, version, compute)
    assert compute.calls == 4


def test_nothing_is_kept_of_a_failed_computation(tmp_path: Path) -> None:
    def fail() -> dict[str, NDArray[Any]]:
        raise ValueError("the mesh is flat")

    with pytest.raises(ValueError, match="flat"):
        Cache(tmp_path).arrays("thing", KEY, "1", fail)
    assert not list(tmp_path.rglob("*.npz"))


def _cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _flip(place: float) -> Callable[[bytes], bytes]:
    def flip(content: bytes) -> bytes:
        k = int(place * (len(content) - 1))
        return content[:k] + bytes([content[k] ^ 1]) + content[k + 1 :]

    return flip


DAMAGES = {
    "empty": lambda _: b"",
    "cut off": _cut,
    "one byte": lambda content: content[:1],
    "the digest alone": lambda content: content[:32],
    "bytes added": lambda content: content + b"\0",
    "zeros": lambda content: bytes(len(content)),
    "text": lambda _: b"not found\n" * 20,
    **{f"a bit at {place}": _flip(place) for place in (0, 0.1, 0.3, 0.5, 0.7, 0.9, 1)},
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_file_is_computed_again(
    damage: Callable[[bytes], bytes], tmp_path: Path, compute: Computation
) -> None:
    whole = Cache(tmp_path).arrays("thing", KEY, "1", compute)
    path = _file(tmp_path)
    content = path.read_bytes()
    path.write_bytes(damage(content))
    assert _same(Cache(tmp_path).arrays("thing", KEY, "1", compute), whole)
    assert compute.calls == 2
    assert path.read_bytes() == content, "and mended"


def test_a_folder_in_the_place_of_a_file_is_no_obstacle(tmp_path: Path, compute: Computation) -> None:
    (tmp_path / "thing-1" / f"{KEY}.npz").mkdir(parents=True)
    for _ in range(2):
        Cache(tmp_path).arrays("thing", KEY, "1", compute)
    assert compute.calls == 2


def test_a_place_that_cannot_be_written_is_worked_without(tmp_path: Path, compute: Computation) -> None:
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", Path("/dev/null/cache"), Path("/proc/cache"), Path("/dev/full")):
        assert _same(Cache(place).arrays("thing", KEY, "1", compute), Cache(None).arrays("thing", KEY, "1", compute))


def test_a_full_disk_is_worked_without(tmp_path: Path) -> None:
    """The largest file that a process may write stands for it; nothing half-written is left."""
    code = (
        "import resource, signal, sys; from pathlib import Path; import numpy as np\n"
        "from synthetless.io.cache import Cache\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))\n"
        "made = Cache(Path(sys.argv[1])).arrays('thing', 'ab', '1', lambda: {'zeros': np.zeros(10_000)})\n"
        "print(made['zeros'].shape)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=False)
    assert done.stdout == "(10000,)\n", done.stderr
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_many_writers_at_once_agree(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; import numpy as np; from synthetless.io.cache import Cache\n"
        "for k in range(200):\n"
        "    values = np.arange(20_000) + k % 5\n"
        "    made = Cache(Path(sys.argv[1])).arrays('thing', str(k % 5), '1', lambda: {'a': values})\n"
        "    assert (made['a'] == values).all()\n"
        "    if k % 3 == 0: (Path(sys.argv[1]) / 'thing-1' / f'{k % 5}.npz').unlink(missing_ok=True)\n"
    )
    writers = [subprocess.Popen([sys.executable, "-c", code, tmp_path]) for _ in range(3)]
    assert [writer.wait(timeout=100) for writer in writers] == [0, 0, 0]
    assert not list(tmp_path.rglob("*.part"))


def test_where_the_cache_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    assert Cache.default() == Cache(tmp_path)
    for word in ("0", "off", " OFF ", "none"):
        monkeypatch.setenv(CACHE_VARIABLE, word)
        assert Cache.default() == Cache(None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    for unset in ("", None):
        monkeypatch.setenv(CACHE_VARIABLE, unset) if unset is not None else monkeypatch.delenv(CACHE_VARIABLE)
        assert Cache.default() == Cache(tmp_path / "xdg" / "synthetless")
    monkeypatch.setenv("XDG_CACHE_HOME", "~/nowhere")
    monkeypatch.delenv("HOME", raising=False)
    folder = Cache.default().folder
    assert folder is None or folder.is_absolute()


def test_a_digest_tells_types_shapes_and_values_apart() -> None:
    numbers = np.arange(6.0)
    distinct = [
        (numbers,),
        (numbers.reshape(2, 3),),
        (numbers.reshape(3, 2),),
        (numbers.astype(np.float32),),
        (numbers[:3], numbers[3:]),
        (numbers[:2], numbers[2:]),
        (numbers[::-1],),
        (),
    ]
    assert len({digest(*arrays) for arrays in distinct}) == len(distinct)
    assert digest(numbers.reshape(2, 3)) == digest(np.asfortranarray(numbers.reshape(2, 3)))
