"""The linear image as OpenEXR."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def encode_exr(linear: NDArray[np.float32]) -> bytes:
    """(H, W, 3) linear light, Rec. 709 primaries, as an OpenEXR file of half floats. The same bytes every time."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = np.ascontiguousarray(np.clip(linear, 0, np.finfo(np.float16).max).astype(np.float16))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.exr"
        OpenEXR.File(header, {"RGB": pixels}).write(str(path))
        return path.read_bytes()
