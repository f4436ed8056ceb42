"""Files that are whole or absent: written beside their place, then renamed into it."""

from __future__ import annotations

import json
import os
import shutil
import socket
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO


@contextmanager
def atomic_file(path: Path, durable: bool = False) -> Iterator[BinaryIO]:
    """A binary file to write, which takes the place of ``path`` when the block ends well and vanishes otherwise.

    Args:
        path: where the file is to be; missing parent folders are made.
        durable: wait until the content is on the disk before the renaming, so that not even a power cut leaves
            an empty file. Costs milliseconds.

    Raises:
        ValueError: the file cannot be written.
    """
    draft = path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with draft.open("wb") as file:
            yield file
            if durable:
                file.flush()
                os.fsync(file.fileno())
        draft.replace(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        with suppress(OSError):
            draft.unlink()


def atomic_write(path: Path, data: bytes, durable: bool = False) -> None:
    """Write a whole file at once; arguments and errors as in ``atomic_file``."""
    with atomic_file(path, durable) as file:
        file.write(data)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """A folder to fill, which becomes ``path`` when the block ends well and vanishes otherwise.

    Raises:
        ValueError: ``path`` is a file or a folder that holds something, or cannot be written.
    """
    path = path.resolve()
    draft = path.with_name(f".{path.name}.part")
    try:
        if path.is_file() or (path.is_dir() and any(path.iterdir())):
            raise ValueError(f"{path}: exists already; give a new or an empty folder")
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(parents=True)
        yield draft
        draft.replace(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object with one entry per line, in the mapping's order, keys inside the entries sorted.

    Floats are written with as many digits as it takes to read the same float64 back.

    Raises:
        ValueError: a number is not finite, or the file cannot be written.
    """
    atomic_write(path, json_bytes(path, content), durable=True)


def json_bytes(path: Path, content: Mapping[str, Any]) -> bytes:
    """What ``write_json`` writes to ``path``, which here only tells where a number is not finite.

    Raises:
        ValueError: a number is not finite.
    """
    lines = (f"  {json.dumps(key)}: {_line(path, value)}" for key, value in content.items())
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        ValueError: the file is missing, is cut off or otherwise no JSON, names a key twice, or holds something
            else than an object.
    """
    content = _parse(read_bytes(path), str(path))
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds a JSON {type(content).__name__}; an object is needed")
    return content


def write_json_lines(path: Path, records: Iterable[Any]) -> None:
    """Write one JSON value per line; errors as in ``write_json``."""
    atomic_write(path, "".join(_line(path, record) + "\n" for record in records).encode(), durable=True)


def read_json_lines(path: Path) -> list[Any]:
    """Read one JSON value per line.

    Raises:
        ValueError: the file is missing, or a line is no JSON; the message names the line.
    """
    lines = read_bytes(path).splitlines()
    return [_parse(line, f"{path}, line {number}") for number, line in enumerate(lines, start=1)]


def read_bytes(path: Path) -> bytes:
    """The content of a file.

    Raises:
        ValueError: it is missing or unreadable.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise ValueError(f"{path}: not found") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error


def _line(path: Path, value: Any) -> str:
    try:
        return json.dumps(value, sort_keys=True, allow_nan=False)
    except ValueError as error:
        raise ValueError(f"{path}: not written, a number in it is not finite ({error})") from None


def _parse(data: bytes, place: str) -> Any:
    try:
        return json.loads(data, object_pairs_hook=_unique)
    except ValueError as error:  # JSONDecodeError, UnicodeDecodeError and the hook's own
        raise ValueError(f"{place}: not valid JSON, cut off or damaged ({error})") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f'key "{next(key for key in keys if keys.count(key) > 1)}" occurs twice')
    return content
