"""The recorded scene in words: what was drawn for an image, in sections of names and values."""

from __future__ import annotations

from typing import Any

import numpy as np

from synthetless.dataset.records import CameraEntry, ImageSpec
from synthetless.scenes.color import srgb
from synthetless.scenes.spec import Material, PlaneSpec, SensorSpec, Vector, View
from synthetless.scenes.textures import PhotoTexture

Section = dict[str, Any]


def sections(camera: CameraEntry, recorded: ImageSpec | None) -> list[Section]:
    """Sections of an image: {"title", "rows"}, a row being [name, value] or [name, value, CSS colour]."""
    fx, _, cx, _, fy, cy = (float(value) for value in camera["cam_K"][:6])
    pinhole = [["focal lengths", f"{fx:.2f}, {fy:.2f} px"], ["principal point", f"{cx:.2f}, {cy:.2f} px"]]
    if recorded is None:
        return [{"title": "Camera", "rows": pinhole}]
    spec = recorded.scene
    return [
        {"title": "Camera", "rows": _view(spec.views[recorded.view]) + pinhole},
        {
            "title": "Light",
            "rows": [
                ["lamp strength", f"{spec.light.strength:.2f}"],
                ["lamp colour", _hex(spec.light.color), _hex(spec.light.color)],
                ["lamp azimuth", f"{spec.light.azimuth_deg:.1f}°"],
                ["lamp elevation", f"{spec.light.elevation_deg:.1f}°"],
                ["lamp distance", f"{spec.light.distance_m:.2f} m"],
                ["lamp radius", f"{1000 * spec.light.radius_m:.0f} mm"],
                ["ambient level", f"{spec.ambient.level:.2f}"],
                ["exposure gain", f"{recorded.exposure_gain:.2f}"],
            ],
        },
        {"title": "Table", "rows": _plane(spec.plane)},
        {
            "title": "Drop",
            "rows": [
                ["drop", str(spec.drop)],
                ["throw", str(spec.attempt + 1)],
                ["view", f"{recorded.view + 1} of {len(spec.views)}"],
                ["objects dropped", str(len(spec.objects))],
            ],
        },
        *([] if recorded.sensor is None else [{"title": "Sensor", "rows": _sensor(recorded.sensor)}]),
    ]


def material(recorded: ImageSpec | None, gt_id: int) -> list[str]:
    """[words, CSS colour] of a labelled instance's material; nothing if it was not recorded."""
    if recorded is None:
        return []
    made_of: Material = recorded.scene.objects[recorded.instances[gt_id]].material
    colour = _hex(made_of.albedo)
    return [f"{colour}, roughness {made_of.roughness:.2f}, specular {made_of.specular:.2f}", colour]


def _view(view: View) -> list[list[str]]:
    return [
        ["distance", f"{view.distance_m:.3f} m"],
        ["elevation", f"{view.elevation_deg:.1f}°"],
        ["azimuth", f"{view.azimuth_deg:.1f}°"],
        ["roll", f"{view.roll_deg:.1f}°"],
    ]


def _sensor(sensor: SensorSpec) -> list[list[str]]:
    return [
        ["point spread", f"{sensor.blur_px:.2f} px"],
        ["vignetting", f"{sensor.vignetting:.2f}"],
        ["over-exposure", f"{sensor.exposure_ev:+.2f} stops"],
        ["highlight shoulder", f"{sensor.shoulder:.2f}"],
        ["photons at full scale", f"{sensor.photons:.0f}"],
        ["read noise", f"{sensor.read_noise:.4f}"],
        ["white balance", f"red {sensor.red_gain:.2f}, blue {sensor.blue_gain:.2f}"],
        ["chroma smoothing", f"{sensor.chroma_px:.2f} px"],
        ["sharpening", f"{sensor.sharpen:.2f} at {sensor.sharpen_px:.2f} px"],
        ["JPEG inside the camera", "none" if sensor.jpeg_quality is None else f"quality {sensor.jpeg_quality}"],
    ]


def _plane(plane: PlaneSpec) -> list[list[str]]:
    texture = plane.texture
    words = texture.file if isinstance(texture, PhotoTexture) else f"{texture.family}, seed {texture.seed}"
    return [
        ["texture", words],
        ["tile", f"{plane.tile_m:.2f} m, turned {plane.rotation_deg:.0f}°"],
        ["roughness", f"{plane.roughness:.2f}"],
        ["specular", f"{plane.specular:.2f}"],
    ]


def _hex(linear: Vector) -> str:
    red, green, blue = np.rint(255 * srgb(np.array(linear, dtype=np.float32))).astype(int).tolist()
    return f"#{red:02x}{green:02x}{blue:02x}"
