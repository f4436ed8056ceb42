"""Taking a few files out of an archive or a folder that nobody vouches for.

An archive decides neither where a file goes nor how much is written: the caller names the wanted files, anything that
points outside is refused, and number and size of the entries are bounded.
"""

from __future__ import annotations

import errno
import lzma
import re
import shutil
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

from synthetless.errors import UserError

_CHUNK_BYTES = 1 << 20
_DAMAGE = (
    *(zipfile.BadZipFile, tarfile.TarError, lzma.LZMAError, zlib.error, EOFError),
    *(NotImplementedError, RuntimeError),  # an unknown compression or a password, by zipfile
)


class ArchiveError(UserError):
    """An archive that is damaged, dangerous or holds something else; the message is one line."""


@dataclass(frozen=True)
class Member:
    """A file of an archive or a folder.

    Attributes:
        name: its path inside, with forward slashes.
        size_bytes: as declared.
        regular: False for links, devices and pipes.
        open: gives its content.
    """

    name: str
    size_bytes: int
    regular: bool
    open: Callable[[], IO[bytes] | None]


@dataclass(frozen=True)
class Limits:
    """What an archive may hold altogether, wanted or not."""

    files: int
    size_bytes: int


@contextmanager
def open_archive(path: Path) -> Iterator[Iterator[Member]]:
    """The members of a zip or tar archive, told apart by content; to be used in order.

    Raises:
        ArchiveError: it is neither, or damaged; also while its members are read. Does not name the archive.
    """
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                yield _zip_members(archive)
        elif tarfile.is_tarfile(path):
            with tarfile.open(path) as archive:
                yield _tar_members(archive)
                if archive.fileobj:
                    archive.fileobj.read(_CHUNK_BYTES)  # on to the end, where gzip and xz check what they gave out
        else:
            raise ArchiveError("neither a zip nor a tar archive, or cut off")
    except _DAMAGE as error:
        raise ArchiveError(f"damaged or cut off ({' '.join(str(error).split())})") from None
    except OSError as error:
        if error.errno not in {None, errno.EINVAL}:
            raise
        raise ArchiveError(f"damaged ({error})") from None  # so say gzip and bzip2, and zip files with absurd offsets


def folder_members(folder: Path, prefix: str, wanted: re.Pattern[str]) -> Iterator[Member]:
    """The wanted files below a folder as if they were in an archive, in a folder called ``prefix``."""
    for path in folder.rglob("*"):
        name = f"{prefix}/{path.relative_to(folder).as_posix()}"
        if wanted.fullmatch(name) and path.is_file():
            yield Member(name, path.stat().st_size, True, _reader(path))


def _reader(path: Path) -> Callable[[], IO[bytes]]:
    return lambda: path.open("rb")


def unpack(members: Iterator[Member], wanted: re.Pattern[str], target: Path, limits: Limits) -> int:
    """Write the wanted members below a folder.

    Args:
        members: in the archive's order.
        wanted: matches the whole name of a member that is to be had; its first group is the path below ``target``.
        target: an existing folder.
        limits: of all members together.

    Returns:
        Number of files written.

    Raises:
        ArchiveError: a name points outside, a wanted member is a link or comes twice, or a limit is passed. Does not
            name the archive.
        OSError: a file cannot be written.
    """
    count, size_bytes = 0, 0
    for number, member in enumerate(members, start=1):
        size_bytes += member.size_bytes
        if number > limits.files:
            raise ArchiveError(f"holds more than {limits.files} files")
        if size_bytes > limits.size_bytes:
            raise ArchiveError(f"unpacks to more than {limits.size_bytes / 1e6:.0f} MB")
        _refuse_outside(member.name)
        if match := wanted.fullmatch(member.name):
            _write(member, target / match[1])
            count += 1
    return count


def _zip_members(archive: zipfile.ZipFile) -> Iterator[Member]:
    for info in archive.infolist():
        if not info.is_dir():
            kind = info.external_attr >> 28  # upper four bits of the Unix mode, 0 where the archive knows no modes
            yield Member(info.filename, info.file_size, kind in {0, 0o10}, partial(archive.open, info))


def _tar_members(archive: tarfile.TarFile) -> Iterator[Member]:
    for info in archive:
        if not info.isdir():
            yield Member(info.name, info.size, info.isreg(), partial(archive.extractfile, info))


def _refuse_outside(name: str) -> None:
    if name.startswith(("/", "\\")) or re.match(r"[A-Za-z]:", name) or ".." in re.split(r"[/\\]", name):
        raise ArchiveError(f"refused: an entry is called {name!r} and points outside")


def _write(member: Member, path: Path) -> None:
    source = member.open() if member.regular else None
    if source is None:
        raise ArchiveError(f"refused: {member.name!r} is a link or a device, not a file")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with source, path.open("xb") as file:
            shutil.copyfileobj(source, file, _CHUNK_BYTES)  # both formats give no more than the declared size
    except FileExistsError:
        raise ArchiveError(f"refused: {member.name!r} comes twice") from None
