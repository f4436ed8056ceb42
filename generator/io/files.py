"""Files that are whole or absent, written beside their place and then renamed into it; and locks on folders."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import re
import shutil
import socket
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO

import psutil

from synthetless.errors import UserError


@contextmanager
def atomic_file(path: Path, durable: bool = False) -> Iterator[BinaryIO]:
    """A binary file to write, which takes the place of ``path`` when the block ends well and vanishes otherwise.

    Args:
        path: where the file is to be; missing parent folders are made.
        durable: wait until the content is on the disk before the renaming, so that not even a power cut leaves
            an empty file. Costs milliseconds.

    Raises:
        UserError: the file cannot be written.
    """
    draft = _draft(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with draft.open("wb") as file:
            yield file
            if durable:
                file.flush()
                os.fsync(file.fileno())
        draft.replace(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        with suppress(OSError):
            draft.unlink()


def atomic_write(path: Path, data: bytes, durable: bool = False) -> None:
    """Write a whole file at once; arguments and errors as in ``atomic_file``."""
    with atomic_file(path, durable) as file:
        file.write(data)


def replace_file(source: Path, target: Path) -> None:
    """Move a whole file to where another one may be, on another disk, too; at every moment one of them is there.

    Raises:
        UserError: it cannot be written there.
    """
    try:
        source.replace(target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise UserError(f"{target}: cannot be written ({error.strerror})") from error
        atomic_write(target, read_bytes(source), durable=True)
        source.unlink()


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file that is never changed in place a second name; a copy where the disk has no hard links.

    Raises:
        UserError: it cannot be read, or not be written there.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            target.hardlink_to(source)
        except OSError:  # another disk, or one without hard links
            shutil.copyfile(source, target)
    except OSError as error:
        raise UserError(f"{target}: cannot be written ({error.strerror or error})") from error


@contextmanager
def atomic_folder(path: Path, replace: bool = False) -> Iterator[Path]:
    """A folder to fill, which becomes ``path`` when the block ends well and vanishes otherwise.

    Where several processes fill the same folder, the first to end has it, and the others fail.

    Args:
        path: where the folder is to be; missing parent folders are made.
        replace: take the place of a folder that is there, with everything in it.

    Raises:
        UserError: ``path`` is a file, or a folder that holds something and is not to be replaced, or cannot be written.
    """
    path = path.resolve()
    draft = _draft(path)
    try:
        if path.is_file() or (not replace and path.is_dir() and any(path.iterdir())):
            raise UserError(f"{path}: exists already; give a new or an empty folder")
        remove_drafts(path.parent, path.name)
        draft.mkdir(parents=True)
        yield draft
        if replace and path.exists():
            former = draft.with_suffix(".former.part")
            path.replace(former)
            draft.replace(path)
            shutil.rmtree(former, ignore_errors=True)
        else:
            draft.replace(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def remove_file(path: Path) -> None:
    """Remove a file, if it is there.

    Raises:
        UserError: it cannot be removed.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{path}: cannot be removed ({error.strerror})") from None


def remove_drafts(folder: Path, name: str | None = None) -> None:
    """Remove what processes of this machine left in a folder when they were killed while they wrote to it.

    Args:
        folder: where the files or folders were to be; need not exist.
        name: of the one that was being written; None for any.
    """
    host = re.escape(socket.gethostname())
    pattern = re.compile(rf"\.{'.+' if name is None else re.escape(name)}\.{host}\.(\d+)(\.former)?\.part")
    for left in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = pattern.fullmatch(left.name)
        if match is None or psutil.pid_exists(int(match[1])):
            continue
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink(missing_ok=True)


def _draft(path: Path) -> Path:
    """What is being written, beside its place: a name of this process, so that others write theirs."""
    return path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}.part")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object with one entry per line, in the mapping's order, keys inside the entries sorted.

    Floats are written with as many digits as it takes to read the same float64 back.

    Raises:
        UserError: a number is not finite, or the file cannot be written.
    """
    atomic_write(path, json_bytes(path, content), durable=True)


def json_bytes(path: Path, content: Mapping[str, Any]) -> bytes:
    """What ``write_json`` writes to ``path``, which here only tells where a number is not finite.

    Raises:
        UserError: a number is not finite.
    """
    lines = (f"  {json.dumps(key)}: {_line(path, value)}" for key, value in content.items())
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        UserError: the file is missing, is cut off or otherwise no JSON, names a key twice, or holds something
            else than an object.
    """
    content = _parse(read_bytes(path), str(path))
    if not isinstance(content, dict):
        raise UserError(f"{path}: holds a JSON {type(content).__name__}; an object is needed")
    return content


def write_json_lines(path: Path, records: Iterable[Any]) -> None:
    """Write one JSON value per line; errors as in ``write_json``."""
    atomic_write(path, "".join(_line(path, record) + "\n" for record in records).encode(), durable=True)


def read_json_lines(path: Path) -> list[Any]:
    """Read one JSON value per line.

    Raises:
        UserError: the file is missing, or a line is no JSON; the message names the line.
    """
    lines = read_bytes(path).splitlines()
    return [_parse(line, f"{path}, line {number}") for number, line in enumerate(lines, start=1)]


def read_bytes(path: Path, at_most: int | None = None) -> bytes:
    """The content of a regular file.

    Args:
        path: of the file, or of a link to one.
        at_most: its largest size.

    Raises:
        UserError: it is missing, unreadable, larger, or something else, such as a pipe that never ends.
    """
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:  # no waiting at a pipe
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise UserError(f"{path}: is no regular file")
            if at_most is not None and status.st_size > at_most:
                raise UserError(f"{path}: has {status.st_size} bytes; at most {at_most} are read")
            return file.read()
    except FileNotFoundError:
        raise UserError(f"{path}: not found") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from error


def _line(path: Path, value: Any) -> str:
    try:
        return json.dumps(value, sort_keys=True, allow_nan=False)
    except ValueError as error:
        raise UserError(f"{path}: not written, a number in it is not finite ({error})") from None


def _parse(data: bytes, place: str) -> Any:
    try:
        return json.loads(data, object_pairs_hook=unique_keys)
    except RecursionError:
        raise UserError(f"{place}: is nested too deeply") from None
    except ValueError as error:  # JSONDecodeError, UnicodeDecodeError and the hook's own
        raise UserError(f"{place}: not valid JSON, cut off or damaged ({error})") from None


def unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """For ``json.loads``: an object, a ValueError if it names a key twice."""
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        raise UserError(f'key "{next(key for key in keys if keys.count(key) > 1)}" occurs twice')
    return content


def nearest_existing(folder: Path) -> Path:
    """The folder itself, or the innermost of its parents that exists."""
    absolute = folder.absolute()
    return next(place for place in (absolute, *absolute.parents) if place.is_dir())


class LockedError(UserError):
    """Another process is at work in the folder; the message is one line."""


@contextmanager
def locked(root: Path, part: str | None = None) -> Iterator[None]:
    """Keep other writers out of a dataset's folder for the duration; those of other parts may come in.

    Args:
        root: the dataset's folder.
        part: name of the share of the work that is done; None for all of it.

    Raises:
        LockedError: another process is at work in it.
        UserError: the folder cannot be written.
    """
    whole = root / ".synthetless.lock"
    busy = f"{root}: another synthetless is writing here; let it finish, or stop it"
    if part is None:
        with _flock(whole, fcntl.LOCK_EX | fcntl.LOCK_NB, busy):
            yield
    else:
        own = root / f".synthetless.{part}.lock"
        with _flock(whole, fcntl.LOCK_SH | fcntl.LOCK_NB, busy), _flock(own, fcntl.LOCK_EX | fcntl.LOCK_NB, busy):
            yield


def is_locked(root: Path) -> bool:
    """Whether another process holds a lock on a dataset's folder. Nothing is written."""
    for path in root.glob(".synthetless*.lock"):
        with suppress(FileNotFoundError, PermissionError), path.open("rb") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
    return False


@contextmanager
def in_turn(root: Path) -> Iterator[None]:
    """Wait until no other process assembles the folder, and keep them waiting for the duration."""
    while True:
        try:
            with _flock(root / ".synthetless.assembly.lock", fcntl.LOCK_EX, ""):
                yield
                return
        except LockedError:  # the one before has taken the file away
            continue


def user_folder() -> Path:
    """This user's own folder among the temporary files of this machine; what is in it may be deleted at any time.

    Raises:
        UserError: it cannot be made; or it is somebody else's, or open to others, who could put files of theirs there.
    """
    folder = Path(tempfile.gettempdir()) / f"synthetless-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise UserError(f"{folder}: cannot be used ({error.strerror}); remove it, or set TMPDIR") from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise UserError(f"{folder}: must be a folder of yours with mode 0700, no link; remove it, or set TMPDIR")
    return folder


def claim(name: str) -> int:
    """Take the first number, counted from 0, that no other process of this user on this machine has taken.

    It is given back when this process ends, however that comes about.

    Raises:
        UserError: the user's folder among the temporary files cannot be used.
    """
    folder = user_folder()
    for number in count():
        path = folder / f"{name}-{number}.lock"
        try:
            lock = os.open(path, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW, 0o600)
        except OSError as error:
            raise UserError(f"{path}: cannot be written ({error.strerror})") from None
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held as long as the descriptor is open
            return number
        except BlockingIOError:
            os.close(lock)
        except OSError as error:
            raise UserError(f"{path}: cannot be locked ({error.strerror}); set TMPDIR to another folder") from None
    raise AssertionError("there are always more numbers")


@contextmanager
def _flock(path: Path, mode: int, busy: str) -> Iterator[None]:
    """Hold a lock file; who holds it alone takes it away in the end, so that nothing of the lock remains."""
    try:
        lock = path.open("a")
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from None
    with lock:
        try:
            fcntl.flock(lock, mode)
            taken_away = not os.path.samestat(path.stat(), os.fstat(lock.fileno()))
        except BlockingIOError:
            raise LockedError(busy) from None
        except FileNotFoundError:
            taken_away = True
        except OSError as error:
            raise UserError(
                f"{path}: this file system cannot lock files ({error.strerror}); "
                "give a folder on another one, or mount it with locks (Lustre: -o flock)"
            ) from None
        if taken_away:
            raise LockedError(busy)
        try:
            yield
        finally:
            if mode & fcntl.LOCK_EX:
                with suppress(OSError):  # the folder may have become read-only; the file alone locks nobody out
                    path.unlink()
