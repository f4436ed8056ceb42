"""Downloads over HTTP that survive a broken line: what has arrived is kept, and gone on with."""

from __future__ import annotations

import fcntl
import http.client
import json
import logging
import re
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

from tqdm import tqdm

from synthetless.errors import UserError
from synthetless.io.files import atomic_write

_log = logging.getLogger(__name__)

_CHUNK_BYTES = 1 << 18
_TRY_AGAIN = {408, 425, 429, 500, 502, 503, 504}
_RANGE_NOT_SATISFIABLE = 416


class DownloadError(UserError):
    """A file that cannot be had; the message is one line."""


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
    """Download a file; what an earlier, interrupted call left is gone on with where the server allows it.

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
            return transfer.go_on()
        except _Interrupted as reason:
            have = transfer.file.tell()
            failures = 0 if have > furthest else failures + 1
            furthest = max(furthest, have)
            if failures >= persistence.attempts:
                kept = f"; run it again to go on from {have / 1e6:.1f} MB" if have else ""
                raise DownloadError(f"{transfer.address}: {reason}{kept}") from None
            wait_s = persistence.wait_s(failures)
            _log.warning("%s: %s; trying again in %.0f s", transfer.address, reason, wait_s)
            time.sleep(wait_s)


@dataclass(frozen=True)
class _Transfer:
    address: str
    part: Path
    file: BinaryIO
    limit_bytes: int
    reserve_bytes: int
    timeout_s: float

    def go_on(self) -> None:
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
            return urllib.request.urlopen(urllib.request.Request(self.address, headers=headers), timeout=self.timeout_s)
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
        """Where the response begins in the file; a server may ignore the wish for a range, or have another file now."""
        if response.status != http.client.PARTIAL_CONTENT:
            self.forget()
            return 0
        match = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", response.headers.get("Content-Range", ""))
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
    return start + int(length) if length.isdigit() else None


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
