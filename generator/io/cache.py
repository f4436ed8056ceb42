"""Arrays that take long to compute, kept between runs in the user's cache folder.

The cache never changes a result and never stops a run: a file that is damaged, cut off or unreadable is computed again,
and where nothing can be written every array is computed each time. The folder may be deleted at any moment.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.io.files import atomic_write

CACHE_VARIABLE = "SYNTHETLESS_CACHE"
"""Environment variable: another folder for the cache, or one of OFF to work without."""

OFF = frozenset({"0", "off", "no", "none", "false"})

_DIGEST_BYTES = hashlib.sha256().digest_size

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Cache:
    """A folder of arrays, one file for each key.

    Safe to share: files are written beside their place and renamed, so that of two writers the later one wins with the
    same content, and each file begins with the SHA-256 of what follows.

    Attributes:
        folder: where the files are, in a subfolder for each kind and version; None to keep nothing.
    """

    folder: Path | None

    @classmethod
    def default(cls) -> Cache:
        """The cache of this user, or the one that the environment variable SYNTHETLESS_CACHE names.

        It is read at each call, so that child processes, which inherit the variable, use the same one.
        """
        place = os.environ.get(CACHE_VARIABLE, "").strip()
        if place.lower() in OFF:
            return cls(None)
        folder = Path(place) if place else platformdirs.user_cache_path("synthetless", appauthor=False)
        # Where the user has no home directory, "~" stays as it is: no folder of that name is to be made.
        return cls(folder.absolute() if place or folder.is_absolute() else None)

    def arrays(self, kind: str, key: str, version: str, compute: Callable[[], Mapping[str, NDArray[Any]]]) -> Arrays:
        """What ``compute`` returns, read from disk if it was computed before.

        Args:
            kind: what is computed, for example "collider"; part of a path.
            key: digest of everything that the result depends on, see ``digest``; part of a path.
            version: of the algorithm, and of the libraries that its last bits depend on; part of a path.
            compute: returns arrays of numbers or fixed-length strings by name; must depend on the key alone.

        Returns:
            The arrays by name, C-contiguous, the same bit for bit whether they were read or computed. They belong to
            the caller.

        Raises:
            Whatever ``compute`` raises; nothing is kept then.
        """
        path = self.folder / f"{kind}-{version}" / f"{key}.npz" if self.folder else None
        if path and (found := _read(path)) is not None:
            return found
        made = {name: np.array(array, order="C") for name, array in compute().items()}
        if path:
            content = _encode(made)
            with suppress(UserError):  # a full disk, a read-only folder: work without
                atomic_write(path, hashlib.sha256(content).digest() + content)
        return made


def digest(*arrays: NDArray[Any]) -> str:
    """SHA-256 of arrays' types, shapes and values, as 64 hexadecimal digits."""
    state = hashlib.sha256()
    for array in arrays:
        state.update(f"{array.dtype.str}{array.shape};".encode())
        state.update(np.ascontiguousarray(array).tobytes())
    return state.hexdigest()


def _encode(arrays: Arrays) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _read(path: Path) -> Arrays | None:
    """The arrays of a file; None if it is missing, unreadable, or its content is not what was written."""
    try:
        stored = path.read_bytes()
    except OSError:
        return None
    content = stored[_DIGEST_BYTES:]
    if hashlib.sha256(content).digest() != stored[:_DIGEST_BYTES]:
        return None
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}
