"""Public data that the project does not carry: fetched from where it is published, checked, and put in its place."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from synthetless.errors import UserError
from synthetless.fetch.archive import ArchiveError, Member, folder_members, open_archive, unpack
from synthetless.fetch.download import DownloadError, Persistence, download, is_address
from synthetless.fetch.sources import SOURCES, DataSource
from synthetless.io.files import atomic_folder, atomic_write

__all__ = ["ArchiveError", "DownloadError", "FetchReport", "Persistence", "fetch", "obtain"]


@dataclass(frozen=True)
class FetchReport:
    """What is in its place now.

    Attributes:
        title: what it is.
        folder: where: a models folder, or one of photographs.
        files: how many.
        size_bytes: of all of them.
        fetched: False if it was there already.
        licence: terms and attribution, as stored in ``licence_file``.
        licence_file: beside the folder.
    """

    title: str
    folder: Path
    files: int
    size_bytes: int
    fetched: bool
    licence: str
    licence_file: Path

    def __str__(self) -> str:
        state = "fetched" if self.fetched else "already there"
        return f"{self.title}, {state}: {self.files} files, {self.size_bytes / 1e6:.1f} MB in {self.folder}"


def fetch(what: Literal["tless", "dtd"], to: Path, source: str | None = None) -> FetchReport:
    """Put the T-LESS CAD models into ``to/models_cad``, or the Describable Textures into ``to/images``.

    Does nothing if they are there. An interrupted download is gone on with the next time.

    Args:
        what: tless or dtd.
        to: folder, made if it is missing.
        source: an archive, a folder, or another http(s) address of the archive, instead of the publisher's. From the
            publisher the archive's checksum must be right; from wherever, the content.

    Raises:
        UserError: it cannot be had, is damaged or is something else, or cannot be written.
    """
    if what not in SOURCES:
        raise UserError(f"{what}: nothing known of that name; {' or '.join(SOURCES)} can be fetched")
    return obtain(SOURCES[what], to, source)


def obtain(
    data: DataSource, to: Path, source: str | None = None, persistence: Persistence | None = None
) -> FetchReport:
    """Like ``fetch``, for any data source and any patience with the server."""
    folder = to / data.folder
    missing = not folder.is_dir() or not any(folder.iterdir())
    if missing:
        _place(data, to, source, persistence)
    else:
        _check(data, folder, f"{folder}: there already, but not the {data.title}", "; remove it or take another folder")
    licence_file = to / f"LICENCE-{data.name}.txt"
    if not licence_file.exists():
        atomic_write(licence_file, data.licence.encode())
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    return FetchReport(data.title, folder, len(sizes), sum(sizes), missing, data.licence, licence_file)


def _place(data: DataSource, to: Path, source: str | None, persistence: Persistence | None) -> None:
    name = source or data.address
    with _folder(to), _local(data, to, source, persistence) as origin, atomic_folder(to / data.folder) as draft:
        try:
            with _members(data, origin) as members:
                count = unpack(members, data.wanted, draft, data.limits)
        except ArchiveError as error:
            raise ArchiveError(f"{name}: {error}") from None
        if not count:
            raise ArchiveError(f"{name}: nothing of the {data.title} in it; a folder {data.folder} is expected")
        _check(data, draft, f"{name}: not the {data.title}")


@contextmanager
def _folder(path: Path) -> Iterator[None]:
    """A folder, made if it is missing; gone again if nothing came into it."""
    made = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArchiveError(f"{path}: cannot be made a folder ({error.strerror})") from None
    try:
        yield
    finally:
        if made:
            with suppress(OSError):
                path.rmdir()


def _check(data: DataSource, folder: Path, complaint: str, advice: str = "") -> None:
    try:
        data.check(folder)
    except ValueError as error:
        reason = str(error).replace(f"{folder.resolve()}/", "").replace(f"{folder}/", "")
        raise ArchiveError(f"{complaint} ({reason}){advice}") from None


@contextmanager
def _local(data: DataSource, to: Path, source: str | None, persistence: Persistence | None) -> Iterator[Path]:
    """The source as a local folder or archive; a downloaded archive is gone at the end."""
    if source is not None and not is_address(source):
        path = Path(source).expanduser()
        if not path.exists():
            raise ArchiveError(f"{source}: not found; give an archive, a folder or an http(s) address")
        yield path
        return
    archive = to / f".{data.archive}"
    try:
        download(source or data.address, archive, data.archive_bytes, data.unpacked_bytes, persistence)
        if source is None:
            _check_digest(data, archive)
        yield archive
    finally:
        archive.unlink(missing_ok=True)


def _check_digest(data: DataSource, archive: Path) -> None:
    with archive.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != data.sha256:
        raise ArchiveError(
            f"{data.address}: sha256 {digest[:12]}... instead of {data.sha256[:12]}...; damaged, or published anew: "
            "try again, or give the address with --from to go by the content alone"
        )


@contextmanager
def _members(data: DataSource, origin: Path) -> Iterator[Iterator[Member]]:
    if origin.is_dir():
        yield folder_members(origin, data.folder, data.wanted)
    else:
        with open_archive(origin) as members:
            yield members
