"""Public data that the project does not carry: fetched from where it is published, checked, and put in its place.

Downloads survive a broken line: what has arrived is kept and continued by the next attempt, or the next call. (pooch
was tried: it drops what has arrived, and bounds neither size nor disk.) Archives are not trusted: they decide neither
where a file goes nor how much is written.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import http.client
import json
import logging
import lzma
import re
import shutil
import tarfile
import time
import urllib.error
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, BinaryIO, Literal
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from tqdm import tqdm

from synthetless.errors import UserError
from synthetless.io.files import atomic_folder, atomic_write
from synthetless.io.meshes import diameter
from synthetless.io.models import load_models

_log = logging.getLogger(__name__)


class ArchiveError(UserError):
    """An archive that is damaged, dangerous or holds something else."""


class DownloadError(UserError):
    """A file that cannot be downloaded."""


# What can be fetched

TLESS_DIAMETERS_MM = (
    *(63.515, 66.151, 65.349, 80.726, 108.690, 108.265, 178.615, 217.156, 144.546, 90.211),
    *(76.598, 86.011, 58.126, 71.947, 68.569, 69.188, 112.839, 110.982, 89.069, 98.889),
    *(92.253, 92.253, 142.587, 84.736, 108.801, 108.801, 152.495, 124.778, 134.227, 88.754),
)
"""Diameters of the 30 CAD models as BOP's models_cad/models_info.json gives them, in the order of their ids."""
DIAMETER_TOLERANCE_MM = 0.01
DTD_CATEGORIES, DTD_IMAGES_PER_CATEGORY = 47, 120


@dataclass(frozen=True)
class Limits:
    """What an archive may hold altogether, wanted or not."""

    files: int
    size_bytes: int


@dataclass(frozen=True)
class DataSource:
    """A published archive of which some files are wanted.

    Attributes:
        name: by which it is asked for.
        title: what it is, for messages.
        address: where the archive is published.
        archive: its file name.
        sha256: of the archive as published.
        archive_bytes: a larger download is refused; many times what is published.
        unpacked_bytes: disk that the wanted files take, roughly.
        limits: what any archive of it may hold altogether.
        wanted: matches the names of the wanted members; the first group is the path inside ``folder``.
        folder: what holds the wanted files in the end.
        check: raises ValueError unless a folder holds what is expected.
        licence: terms and attribution.
    """

    name: str
    title: str
    address: str
    archive: str
    sha256: str
    archive_bytes: int
    unpacked_bytes: int
    limits: Limits
    wanted: re.Pattern[str]
    folder: str
    check: Callable[[Path], None]
    licence: str


def check_tless(folder: Path) -> None:
    """The 30 T-LESS CAD models, recognised by their diameters.

    Raises:
        UserError: one is missing, unreadable, of another size than models_info.json says, or another object.
    """
    models = load_models(folder)
    if sorted(models) != list(range(1, len(TLESS_DIAMETERS_MM) + 1)):
        raise UserError(f"holds {len(models)} models with ids {min(models)} to {max(models)}; T-LESS has 1 to 30")
    for obj_id, expected_mm in enumerate(TLESS_DIAMETERS_MM, start=1):
        model = models[obj_id]
        measured_mm = diameter(model.vertices_mm)
        for what, value_mm in ("the mesh", measured_mm), ("models_info.json", model.diameter_mm):
            if abs(value_mm - expected_mm) > DIAMETER_TOLERANCE_MM:
                raise UserError(
                    f"object {obj_id}: diameter {value_mm:.3f} mm by {what}; {expected_mm:.3f} mm is that of T-LESS"
                )


def check_dtd(folder: Path) -> None:
    """The 47 categories of 120 textures each.

    Raises:
        UserError: a category or an image is missing, or an image is empty.
    """
    images = [path for path in folder.glob("*/*") if path.is_file() and not path.name.startswith(".")]
    counts = Counter(path.parent.name for path in images)
    if len(counts) != DTD_CATEGORIES:
        raise UserError(f"holds {len(counts)} categories of textures; DTD has {DTD_CATEGORIES}")
    for category, count in sorted(counts.items()):
        if count != DTD_IMAGES_PER_CATEGORY:
            raise UserError(f"category {category} has {count} images; in DTD each has {DTD_IMAGES_PER_CATEGORY}")
    if empty := [path for path in images if path.stat().st_size == 0]:
        raise UserError(f"{len(empty)} images are empty, {empty[0].parent.name}/{empty[0].name} for one")


TLESS = DataSource(
    name="tless",
    title="T-LESS CAD models",
    address="https://huggingface.co/datasets/bop-benchmark/tless/resolve/main/tless_models.zip",
    archive="tless_models.zip",
    sha256="6a29c59766b8d2af05e62e71739f0ca7243ad81bc3c7f9a24925504a8cb37928",  # 33,468,762 bytes
    archive_bytes=500_000_000,
    unpacked_bytes=50_000_000,
    limits=Limits(files=5_000, size_bytes=2_000_000_000),
    wanted=re.compile(r"(?:.*/)?models_cad/(obj_\d{6}\.ply|models_info\.json)"),
    folder="models_cad",
    check=check_tless,
    licence="""\
T-LESS: An RGB-D Dataset for 6D Pose Estimation of Texture-less Objects
T. Hodan, P. Haluza, S. Obdrzalek, J. Matas, M. Lourakis, X. Zabulis, WACV 2017
https://cmp.felk.cvut.cz/t-less, in the format of BOP: https://bop.felk.cvut.cz

Licence: BOP publishes it on Hugging Face under Creative Commons Attribution 4.0
(CC BY 4.0, https://creativecommons.org/licenses/by/4.0/). The authors' T-LESS
toolkit names Attribution-ShareAlike 4.0 for it instead (CC BY-SA 4.0,
https://creativecommons.org/licenses/by-sa/4.0/). Whoever passes on the models,
or images of them, respects both by keeping to the latter.
""",
)

DTD = DataSource(
    name="dtd",
    title="Describable Textures Dataset",
    address="https://www.robots.ox.ac.uk/~vgg/data/dtd/download/dtd-r1.0.1.tar.gz",
    archive="dtd-r1.0.1.tar.gz",
    sha256="e42855a52a4950a3b59612834602aa253914755c95b0cff9ead6d07395f8e205",  # 625,239,812 bytes
    archive_bytes=2_000_000_000,
    unpacked_bytes=700_000_000,
    limits=Limits(files=20_000, size_bytes=3_000_000_000),
    wanted=re.compile(r"(?:.*/)?images/([^/]+/[^/.][^/]*\.jpe?g)", re.IGNORECASE),
    folder="images",
    check=check_dtd,
    licence="""\
Describable Textures Dataset (DTD), release 1.0.1
M. Cimpoi, S. Maji, I. Kokkinos, S. Mohamed, A. Vedaldi:
Describing Textures in the Wild, CVPR 2014
https://www.robots.ox.ac.uk/~vgg/data/dtd/

Licence: made available to the computer vision community for research purposes.
The images were collected from the web and belong to their photographers; for
other purposes take textures whose licence allows it, such as CC0 ones.
""",
)

SOURCES = {source.name: source for source in (TLESS, DTD)}


# Fetching


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

    Does nothing if they are there. An interrupted download is continued the next time.

    Args:
        what: tless or dtd.
        to: folder, made if it is missing.
        source: an archive, a folder, or another http(s) address of the archive, instead of the publisher's. From the
            publisher the archive's checksum must be right; from wherever, the content.

    Raises:
        UserError: it cannot be fetched, is damaged or is something else, or cannot be written.
    """
    if what not in SOURCES:
        raise UserError(f"{what}: unknown; {' or '.join(SOURCES)} can be fetched")
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
    content = hashlib.sha256()
    with archive.open("rb") as file:
        while block := file.read(1 << 20):
            content.update(block)
    digest = content.hexdigest()
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


# Downloads

_CHUNK_BYTES = 1 << 18
_TRY_AGAIN = {408, 425, 429, 500, 502, 503, 504}
_RANGE_NOT_SATISFIABLE = 416


@dataclass(frozen=True)
class Persistence:
    """How a download deals with a server that fails.

    Attributes:
        attempts: in a row without a single new byte before it gives up.
        first_wait_s, longest_wait_s: before trying again; the wait doubles each time.
        timeout_s: a server that says nothing for so long has broken off.
    """

    attempts: int = 5
    first_wait_s: float = 1.0
    longest_wait_s: float = 30.0
    timeout_s: float = 30.0

    def wait_s(self, failures: int) -> float:
        """Seconds to wait after so many failures in a row; 0 of them if the last attempt brought something."""
        return float(min(self.first_wait_s * 2 ** max(failures - 1, 0), self.longest_wait_s))


@dataclass(frozen=True)
class _Partial:
    """Whose first bytes a partial file holds: the address, the server's mark of that version, its size if told."""

    address: str
    validator: str | None = None
    total_bytes: int | None = None


class _Interrupted(Exception):
    """The line broke, or the server failed in a way that may pass; the message says how."""


def is_address(source: str) -> bool:
    """Whether it is an http or https address, rather than a path."""
    return re.match(r"https?://[^/]", source, re.IGNORECASE) is not None


def download(
    address: str, target: Path, limit_bytes: int, reserve_bytes: int = 0, persistence: Persistence | None = None
) -> None:
    """Download a file; what an earlier, interrupted call left is continued where the server allows it.

    Args:
        address: http or https.
        target: file to make; until it is whole, it is called ``target.part``, and ``target.part.json`` says of what.
        limit_bytes: a larger file is refused.
        reserve_bytes: of disk that must be free beyond the file's own size.
        persistence: how often to try again.

    Raises:
        DownloadError: the server refuses or keeps failing, the file is too large, or the disk is full.
    """
    persistence = persistence or Persistence()
    part = target.with_name(f"{target.name}.part")
    try:
        with part.open("ab") as file:
            _lock(file, part)
            transfer = _Transfer(address, part, file, limit_bytes, reserve_bytes, persistence.timeout_s)
            try:
                _persist(transfer, persistence)
            finally:
                if file.tell() == 0:
                    part.unlink()
                    _note(part).unlink(missing_ok=True)
        part.replace(target)
        _note(part).unlink(missing_ok=True)
    except OSError as error:
        raise DownloadError(f"{part}: cannot be written ({error.strerror or error})") from error


def _lock(file: BinaryIO, part: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise DownloadError(f"{part}: another download into it is under way; wait for it") from None


def _persist(transfer: _Transfer, persistence: Persistence) -> None:
    """Go on until the file is whole; only failures without a new byte count."""
    if _read_note(transfer.part, transfer.address) is None:
        transfer.forget()
    furthest, failures = transfer.file.tell(), 0
    while True:
        try:
            return transfer.resume()
        except _Interrupted as reason:
            have = transfer.file.tell()
            failures = 0 if have > furthest else failures + 1
            furthest = max(furthest, have)
            if failures >= persistence.attempts:
                kept = f"; run it again to continue from {have / 1e6:.1f} MB" if have else ""
                raise DownloadError(f"{transfer.address}: {reason}{kept}") from None
            wait_s = persistence.wait_s(failures)
            _log.warning("%s: %s; trying again in %.0f s", transfer.address, reason, wait_s)
            time.sleep(wait_s)


class _CarefulRedirects(HTTPRedirectHandler):
    """Follows redirects to http and https alone, and none that gives up encryption."""

    def redirect_request(self, req: Request, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Request | None:
        if urlsplit(newurl).scheme not in {"https", urlsplit(req.full_url).scheme}:
            raise DownloadError(f"{req.full_url}: refused: it redirects to {newurl}")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


@dataclass(frozen=True)
class _Transfer:
    """A download under way.

    Attributes:
        address: what is downloaded.
        part, file: the partial file, open for appending.
        limit_bytes, reserve_bytes, timeout_s: as in ``download`` and ``Persistence``.
    """

    address: str
    part: Path
    file: BinaryIO
    limit_bytes: int
    reserve_bytes: int
    timeout_s: float

    def resume(self) -> None:
        """One request: append what is missing of the file.

        Raises:
            _Interrupted: it ended before the file was whole.
            DownloadError: there is no point in trying again.
        """
        known = _read_note(self.part, self.address)
        start = self.file.tell()
        if known and known.total_bytes and start == known.total_bytes:
            return
        with self._request(known, start) as response:
            start = self._agree(response, known, start)
            total = _total_bytes(response, start)
            self._check_size(total, start)
            _write_note(self.part, _Partial(self.address, _validator(response), total))
            self._append(response, total, start)

    def _request(self, known: _Partial | None, start: int) -> Any:
        headers = {"User-Agent": "synthetless"}
        if start:
            headers["Range"] = f"bytes={start}-"
            if known and known.validator:
                headers["If-Range"] = known.validator
        try:
            request = Request(self.address, headers=headers)
            return build_opener(_CarefulRedirects).open(request, timeout=self.timeout_s)
        except DownloadError:
            raise
        except urllib.error.HTTPError as error:
            if error.code == _RANGE_NOT_SATISFIABLE:
                self.forget()
            elif error.code not in _TRY_AGAIN:
                raise DownloadError(f"{self.address}: HTTP {error.code} {_one_line(error.reason)}") from None
            raise _Interrupted(f"HTTP {error.code} {_one_line(error.reason)}") from None
        except (http.client.InvalidURL, ValueError) as error:
            raise DownloadError(f"{self.address}: not a usable address ({_one_line(error)})") from None
        except urllib.error.URLError as error:
            raise _Interrupted(f"no connection ({_one_line(error.reason)})") from None
        except (OSError, http.client.HTTPException) as error:
            raise _Interrupted(f"the connection broke ({_name(error)})") from None

    def _agree(self, response: Any, known: _Partial | None, start: int) -> int:
        """Where the response begins in the file; a server may ignore the range, or have another file now."""
        if response.status != http.client.PARTIAL_CONTENT:
            self.forget()
            return 0
        match = re.fullmatch(r"bytes (\d{1,18})-\d{1,18}/(\d{1,18}|\*)", response.headers.get("Content-Range", ""))
        expected = str(known.total_bytes) if known and known.total_bytes else "*"
        if not match or int(match[1]) != start or (expected != "*" and match[2] not in {expected, "*"}):
            self.forget()
            raise _Interrupted("the server sent another part than the missing one; starting over")
        return start

    def _check_size(self, total: int | None, start: int) -> None:
        if total is None:
            return
        if total > self.limit_bytes:
            raise DownloadError(f"{self.address}: {_megabytes(total)}, more than {_megabytes(self.limit_bytes)}")
        needed, free = total - start + self.reserve_bytes, shutil.disk_usage(self.part.parent).free
        if needed > free:
            raise DownloadError(f"{self.part.parent}: {_megabytes(needed)} needed, {_megabytes(free)} free")

    def _append(self, response: Any, total: int | None, start: int) -> None:
        have = start
        name = self.part.name.removesuffix(".part").lstrip(".")
        with tqdm(total=total, initial=start, desc=name, unit="B", unit_scale=True, disable=None, leave=False) as bar:
            for chunk in _chunks(response):
                have += len(chunk)
                if have > self.limit_bytes:
                    self.forget()
                    raise DownloadError(f"{self.address}: more than {_megabytes(self.limit_bytes)}")
                self.file.write(chunk)
                bar.update(len(chunk))
        self.file.flush()
        if total is not None and have < total:
            raise _Interrupted(f"the connection closed after {have} of {total} bytes")

    def forget(self) -> None:
        """Drop what has arrived: it is of no use."""
        self.file.truncate(0)
        self.file.seek(0)
        _note(self.part).unlink(missing_ok=True)


def _chunks(response: Any) -> Iterator[bytes]:
    try:
        while chunk := response.read1(_CHUNK_BYTES):  # what has come, so that a break loses nothing
            yield chunk
    except (OSError, http.client.HTTPException) as error:
        raise _Interrupted(f"the connection broke ({_name(error)})") from None


def _total_bytes(response: Any, start: int) -> int | None:
    length = response.headers.get("Content-Length", "")
    return start + int(length) if re.fullmatch(r"[0-9]{1,18}", length) else None


def _validator(response: Any) -> str | None:
    """What to send as If-Range: a strong ETag, or the date of the last change (RFC 9110, section 13.1.5)."""
    etag: str | None = response.headers.get("ETag")
    changed: str | None = response.headers.get("Last-Modified")
    return etag if etag and not etag.startswith("W/") else changed


def _note(part: Path) -> Path:
    return part.with_name(f"{part.name}.json")


def _write_note(part: Path, partial: _Partial) -> None:
    atomic_write(_note(part), json.dumps(asdict(partial)).encode())


def _read_note(part: Path, address: str) -> _Partial | None:
    """What the partial file is part of; None unless it is of the address wanted now."""
    try:
        partial = _Partial(**json.loads(_note(part).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None
    return partial if partial.address == address else None


def _megabytes(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.1f} MB"


def _name(error: BaseException) -> str:
    return _one_line(error) or type(error).__name__


def _one_line(text: object) -> str:
    return " ".join(str(text).split())


# Archives

_DAMAGE = (
    *(zipfile.BadZipFile, tarfile.TarError, lzma.LZMAError, zlib.error, EOFError),
    *(NotImplementedError, RuntimeError),  # an unknown compression or a password, by zipfile
)


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
        wanted: matches the whole name of a wanted member; its first group is the path below ``target``.
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
