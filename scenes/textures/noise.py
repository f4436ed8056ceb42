"""Periodic random fields: the raw material of the procedural textures.

Every field is a square float32 array that continues seamlessly over its borders. Frequencies are in cycles per
tile and lengths in fractions of the tile's side, so that a seed gives the same picture at every size.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import cv2

Field = NDArray[np.float32]  # (size, size)

BAND = 256  # highest frequency of any noise, cycles per tile


def coordinates(rng: np.random.Generator, size: int) -> tuple[Field, Field]:
    """Pixel coordinates (u to the right, v down) in tile sides, each from a random phase to that phase + 1.

    Whatever has period 1 in u and v is seamless; the phase keeps a pattern's own lines off the image's border.
    """
    axis = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(axis + rng.random(), axis + rng.random())
    return u.astype(np.float32), v.astype(np.float32)


def spectral_noise(
    rng: np.random.Generator,
    size: int,
    *,
    slope: float = 1.0,
    low: float = 1.0,
    high: float = BAND,
    stretch: float = 1.0,
    angle_deg: float = 0.0,
) -> Field:
    """Periodic Gaussian noise with mean 0 and variance 1, shaped in the Fourier domain.

    Args:
        slope: the amplitude falls with the frequency f as f**-slope (0 white, 1 pink, 2 clouds).
        low, high: the band in cycles per tile; below `low` nothing, above `high` a Gaussian decay.
        stretch: how many times longer than wide the features are.
        angle_deg: the direction in which they are long, from u towards v.
    """
    parts = rng.standard_normal((2, 2 * BAND, BAND + 1), dtype=np.float32)
    kept = min(BAND, size // 2)
    rows = np.r_[0:kept, -kept:0]
    f_v, f_u = np.meshgrid(rows, np.arange(kept + 1), indexing="ij")
    cosine, sine = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    f = np.hypot(stretch * (f_u * cosine + f_v * sine), f_v * cosine - f_u * sine)
    f[0, 0] = 1.0
    gain = np.where(f >= low, f**-slope * np.exp(-((f / high) ** 2)), 0.0)
    gain[0, 0] = 0.0
    spectrum = np.zeros((size, kept + 1), np.complex128)
    spectrum[rows] = gain * (parts[0] + 1j * parts[1])[rows, : kept + 1]
    field = np.fft.irfft(np.fft.ifft(spectrum, axis=0), size, axis=1)  # irfft2, without the empty columns
    return np.asarray(field / max(float(field.std()), 1e-12), np.float32)


def warp(field: Field, du: Field, dv: Field) -> Field:
    """The periodic field looked up at (u + du, v + dv), du and dv in tile sides, bilinearly."""
    return _lookup(field, du, dv, cv2.INTER_LINEAR)


def warp_labels(labels: NDArray[np.int32], du: Field, dv: Field) -> NDArray[np.int32]:
    """`warp` for labels (below 2**24): the nearest pixel's label."""
    return _lookup(labels.astype(np.float32), du, dv, cv2.INTER_NEAREST).astype(np.int32)


def _lookup(field: Field, du: Field, dv: Field, interpolation: int) -> Field:
    size = len(field)
    y, x = np.indices((size, size), dtype=np.float32)
    found = cv2.remap(field, x + du * size, y + dv * size, interpolation, borderMode=cv2.BORDER_WRAP)
    return np.asarray(found, np.float32)


def blur(field: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Periodic Gaussian blur of a field or an image; sigma in tile sides."""
    sigma_px = sigma * len(field)
    margin = int(np.ceil(4 * sigma_px))
    # GaussianBlur knows no wrap border
    padded = cv2.copyMakeBorder(field, margin, margin, margin, margin, cv2.BORDER_WRAP)
    soft = cv2.GaussianBlur(padded, (0, 0), sigma_px)
    return np.asarray(soft[margin:-margin, margin:-margin], np.float32)


def smoothstep(start: float, end: float, x: Field) -> Field:
    """0 where x is at `start` or beyond, 1 at `end` or beyond, a smooth slope between; end may be below start."""
    t: Field = np.clip((x - start) / (end - start), 0, 1)
    return np.asarray(t * t * (3 - 2 * t), np.float32)


def normalised(field: Field, clip_percent: float = 1.0) -> Field:
    """The field mapped to 0..1, with `clip_percent` of the pixels cut off at each end."""
    low, high = np.percentile(field[::4, ::4], (clip_percent, 100 - clip_percent))
    return np.asarray(np.clip((field - low) / max(float(high - low), 1e-9), 0, 1), np.float32)
