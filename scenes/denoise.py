"""Removes the noise of few samples, by guides that have none.

Cycles' own denoiser is guided by what it has sampled, which is as noisy as the image along edges and in fine texture.
Open Image Denoise takes guides that are known to be clean, too, and keeps every edge that they show. It is called here
through its C interface (https://www.openimagedenoise.org/documentation.html), in the library that bpy comes with.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import cv2
from synthetless.scenes import blender

Image = NDArray[np.float32]

_LIBRARIES = (
    "libOpenImageDenoise.so*",
    "libOpenImageDenoise.[0-9]*dylib",
    "libOpenImageDenoise.dylib",
    "*imagedenoise.dll",
)
_CPU, _FLOAT3 = 1, 3  # OIDN_DEVICE_TYPE_CPU, OIDN_FORMAT_FLOAT3
_BALANCED = 5  # OIDN_QUALITY_BALANCED: in the time that the larger network takes more, paths gain more than it does
_AROUND_PX = 25
"""Side of the square around a pixel whose light stands for its own where the texture is black there."""
_BLACK = np.float32(1e-3)
"""Albedo at which the one counts as much as the other."""
_TINY = np.float32(1e-5)
"""Added to means of albedos that are divided by."""


@dataclass(frozen=True, eq=False)
class Guides:
    """What the surface in each pixel is like, without noise: means over the pixel's area.

    Attributes:
        albedo: (H, W, 3) linear; 0 where there is no surface.
        normals: (H, W, 3) unit normals, averaged; 0 where there is no surface.
        known: (H, W) where the albedo is that of all that is seen.
        textured: (H, W) where it is that of a matte texture alone, of no edge: the light may be taken for even there.
    """

    albedo: Image
    normals: Image
    known: NDArray[np.bool_]
    textured: NDArray[np.bool_]

    def completed(self, sampled: Image) -> Guides:
        """With the albedo as it was sampled, (H, W, 3), where it is not known."""
        return replace(self, albedo=np.where(self.known[..., None], self.albedo, sampled))

    def without_texture(self, linear: Image, sampled: Image) -> tuple[Image, Image, Image]:
        """A noisy image as if what is textured were of one colour, so that a denoiser has no texture to keep.

        A matte surface sends albedo times irradiance, and it is the irradiance that is noisy, and smooth (C. Schied
        et al., Spatiotemporal variance-guided filtering, HPG 2017). Where it is black, its surroundings tell that.

        Args:
            linear: (H, W, 3) the image.
            sampled: (H, W, 3) the albedo that its paths met.

        Returns:
            The image, its albedo, and what brings the texture back when the image is multiplied by it; each (H, W, 3).
        """
        albedo = self.completed(sampled).albedo
        if not self.textured.any():
            return linear, albedo, np.ones_like(linear)
        textured = np.repeat(self.textured[..., None], 3, axis=2)
        plain = self._mean(albedo) + _TINY
        everywhere = self._mean(linear) / (self._mean(sampled) + _TINY)
        around = (_around(linear * textured) + _TINY * everywhere) / (_around(sampled * textured) + _TINY)
        irradiance = (linear + _BLACK * around) / (sampled + _BLACK)
        return (
            np.where(textured, irradiance * plain, linear),
            np.where(textured, plain, albedo),
            np.where(textured, albedo / plain, np.float32(1)),
        )

    def _mean(self, image: Image) -> Image:
        """(3,) of what is textured."""
        return np.array(cv2.mean(image, self.textured.astype(np.uint8))[:3], dtype=np.float32)


def _around(image: Image) -> Image:
    return np.asarray(cv2.blur(image, (_AROUND_PX, _AROUND_PX)), dtype=np.float32)


class Denoiser:
    """Open Image Denoise on the processor. The same images give the same bytes."""

    def __init__(self, threads: int = 1) -> None:
        """Load the library and start its threads; 0 takes every core.

        Raises:
            BlenderError: it cannot be loaded.
        """
        self._library = _load()
        call = self._library
        self._device = call.oidnNewDevice(_CPU)
        call.oidnSetDeviceInt(self._device, b"numThreads", threads)
        call.oidnSetDeviceBool(self._device, b"setAffinity", False)
        call.oidnCommitDevice(self._device)
        self._filter = call.oidnNewFilter(self._device, b"RT")  # kept: its weights are put in order only once
        self._refuse_error()

    def denoise(self, linear: Image, sampled: Image, guides: Guides) -> Image:
        """(H, W, 3) without the noise.

        Args:
            linear: (H, W, 3) noisy image of linear light.
            sampled: (H, W, 3) the albedo that was sampled with it.
            guides: what is known of it.

        Raises:
            ValueError: the guides are not those of such an image.
            BlenderError: the library fails.
        """
        height, width = linear.shape[:2]
        for name, image in (("image", linear), ("albedo", guides.albedo), ("normals", guides.normals)):
            if image.dtype != np.float32 or image.shape != (height, width, 3):
                raise ValueError(
                    f"{name} of shape {image.shape} and type {image.dtype}; float32 like the image is needed"
                )
        call, result = self._library, np.empty_like(linear, order="C")
        color, albedo, texture = guides.without_texture(linear, sampled)
        images = {"color": color, "albedo": albedo, "normal": guides.normals, "output": result}
        images = {name: np.ascontiguousarray(image) for name, image in images.items()}
        for name, image in images.items():
            call.oidnSetSharedFilterImage(
                self._filter, name.encode(), image.ctypes.data, _FLOAT3, width, height, 0, 0, 0
            )
        call.oidnSetFilterBool(self._filter, b"hdr", True)
        call.oidnSetFilterBool(self._filter, b"cleanAux", True)
        call.oidnSetFilterInt(self._filter, b"quality", _BALANCED)
        call.oidnCommitFilter(self._filter)
        call.oidnExecuteFilter(self._filter)
        self._refuse_error()
        return result * texture

    def _refuse_error(self) -> None:
        message = ctypes.c_char_p()
        if self._library.oidnGetDeviceError(self._device, ctypes.byref(message)):
            raise blender.BlenderError(f"Open Image Denoise: {(message.value or b'unknown error').decode()}")


def _load() -> Any:
    """The library, with the types of what is called of it."""
    folder = Path(blender.module().utils.resource_path("LOCAL")).parent
    found = sorted(path for pattern in _LIBRARIES for depth in ("", "*/") for path in folder.glob(depth + pattern))
    if not found:
        raise blender.BlenderError(
            f"{folder}: has no Open Image Denoise; use Blender's own denoiser: --set render.denoiser=fast"
        )
    try:
        library = ctypes.CDLL(str(found[0]))
    except OSError as error:
        raise blender.BlenderError(
            f"{found[0]}: cannot be loaded ({error}); --set render.denoiser=fast does without"
        ) from None
    handle, name, size = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_size_t
    signatures: dict[str, tuple[Any, list[Any]]] = {
        "oidnNewDevice": (handle, [ctypes.c_int]),
        "oidnSetDeviceInt": (None, [handle, name, ctypes.c_int]),
        "oidnSetDeviceBool": (None, [handle, name, ctypes.c_bool]),
        "oidnCommitDevice": (None, [handle]),
        "oidnGetDeviceError": (ctypes.c_int, [handle, ctypes.POINTER(ctypes.c_char_p)]),
        "oidnNewFilter": (handle, [handle, name]),
        "oidnSetSharedFilterImage": (None, [handle, name, handle, ctypes.c_int, size, size, size, size, size]),
        "oidnSetFilterBool": (None, [handle, name, ctypes.c_bool]),
        "oidnSetFilterInt": (None, [handle, name, ctypes.c_int]),
        "oidnCommitFilter": (None, [handle]),
        "oidnExecuteFilter": (None, [handle]),
    }
    for function, (result, arguments) in signatures.items():
        getattr(library, function).restype = result
        getattr(library, function).argtypes = arguments
    return library
