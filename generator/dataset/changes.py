"""Files of a dataset that change together: all of them or none, whenever the process is killed.

The new files are laid out in a hidden folder as they are to lie in the dataset. When the last of them is on the disk,
one renaming of that folder decides: from then on they are the dataset's, and ``complete`` moves to their places what a
killed process has left of them.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from synthetless.errors import UserError
from synthetless.io.files import atomic_write, read_bytes

_DRAFT, _DECIDED = ".relabel.draft", ".relabel"


@contextmanager
def changes(root: Path) -> Iterator[Path]:
    """A folder to fill with files that take the places they have in it in ``root`` when the block ends well.

    If it ends with an exception, or the process is killed before, ``root`` stays as it was. Keep others out of
    ``root`` meanwhile; folders must exist in it already.

    Raises:
        UserError: a file cannot be written.
    """
    complete(root)
    draft = root / _DRAFT
    try:
        draft.mkdir()
        yield draft
        for path in _files(draft):
            _flush(path)
        draft.replace(root / _DECIDED)
    except OSError as error:
        raise UserError(f"{error.filename or draft}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    complete(root)


def complete(root: Path) -> None:
    """Finish changes that were decided, and drop those that were not; nothing happens where there are none.

    Raises:
        UserError: a file cannot be written.
    """
    shutil.rmtree(root / _DRAFT, ignore_errors=True)
    decided = root / _DECIDED
    for path in _files(decided):
        target = root / path.relative_to(decided)
        try:
            path.replace(target)
        except OSError as error:
            if error.errno != errno.EXDEV:
                raise UserError(f"{target}: cannot be written ({error.strerror})") from error
            atomic_write(target, read_bytes(path), durable=True)  # a split may be a link to another disk
            path.unlink()
    shutil.rmtree(decided, ignore_errors=True)


def is_half_changed(root: Path) -> bool:
    """Whether changes were decided, but not all files are in their places yet."""
    return bool(_files(root / _DECIDED))


def refuse_half_changed(root: Path) -> None:
    """For those who only read: labels of two symmetry tables must not get mixed.

    Raises:
        UserError: not all files are in their places.
    """
    if is_half_changed(root):
        raise UserError(f"{root}: is half relabelled; run relabel (or adopt) again, which completes it")


def _files(folder: Path) -> list[Path]:
    """Those of the scene folders first."""
    return sorted((path for path in folder.rglob("*") if path.is_file()), reverse=True)


def _flush(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())
