"""Who may write to a dataset's folder: one, or several that have agreed to share the work by parts."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from generator.plan import Part


class LockedError(ValueError):
    """Another process is at work in the folder; the message is one line."""


@contextmanager
def locked(root: Path, part: Part | None = None) -> Iterator[None]:
    """Keep other writers out of a dataset's folder for the duration; those of other parts may come in.

    Args:
        root: the dataset's folder.
        part: the share of the work that is done; None for all of it.

    Raises:
        LockedError: another process is at work in it.
        ValueError: the folder cannot be written.
    """
    whole = root / ".synthetless.lock"
    busy = f"{root}: another synthetless is writing here; let it finish, or stop it"
    if part is None:
        with _flock(whole, fcntl.LOCK_EX | fcntl.LOCK_NB, busy):
            yield
    else:
        own = root / f".synthetless.{part.number}-of-{part.count}.lock"
        with _flock(whole, fcntl.LOCK_SH | fcntl.LOCK_NB, busy), _flock(own, fcntl.LOCK_EX | fcntl.LOCK_NB, busy):
            yield


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


def claim(name: str) -> int:
    """Take the first number, counted from 0, that no other process of this user on this machine has taken.

    It is given back when this process ends, however that comes about.
    """
    folder = Path(tempfile.gettempdir()) / f"synthetless-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    for number in count():
        lock = os.open(folder / f"{name}-{number}.lock", os.O_CREAT | os.O_RDWR, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held as long as the descriptor is open
        except OSError:
            os.close(lock)
        else:
            return number
    raise AssertionError("there are always more numbers")


@contextmanager
def _flock(path: Path, mode: int, busy: str) -> Iterator[None]:
    """Hold a lock file; who holds it alone takes it away in the end, so that nothing of the lock remains."""
    try:
        lock = path.open("a")
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror})") from None
    with lock:
        try:
            fcntl.flock(lock, mode)
            taken_away = not os.path.samestat(path.stat(), os.fstat(lock.fileno()))
        except OSError:
            raise LockedError(busy) from None
        if taken_away:
            raise LockedError(busy)
        try:
            yield
        finally:
            if mode & fcntl.LOCK_EX:
                path.unlink(missing_ok=True)
