"""One image for the pages: its small pictures, and everything that is drawn into them or listed beside them.

What is drawn is data, as outlines and lines in pixels of the image; pixel (i, j) has its centre at (u, v) = (i, j).
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from synthetless.dataset.labels import box_corners_mm
from synthetless.dataset.layout import CAMERA_FILE
from synthetless.dataset.reader import Image, Instance, Visibility
from synthetless.dataset.records import ImageSpec, ModelInfo
from synthetless.errors import UserError
from synthetless.extras import cv2
from synthetless.io import images
from synthetless.io.files import atomic_write, link_or_copy, read_bytes
from synthetless.io.models import BOX_EDGES
from synthetless.scenes.lens import project
from synthetless.scenes.spec import (
    DepthSensorSpec,
    EnvironmentSpec,
    Material,
    PlaneSpec,
    RoomSpec,
    SensorSpec,
    Vector,
    View,
)
from synthetless.scenes.srgb import srgb_from_linear
from synthetless.scenes.textures import PhotoTexture
from synthetless.symmetry import SymmetryTable
from synthetless.symmetry.ambiguity import Cosets

Floats = NDArray[np.float64]
Pixels = NDArray[np.uint8]
Segment = list[float]
"""A line in the image: [u, v, u', v']."""
Section = dict[str, Any]

_DRAWING = 2
"""Goes up when something else is drawn from the same dataset, so that no former drawing is taken for a new one."""
_GREY = np.uint8(128)
_LARGEST_PX, _THUMBNAIL_PX = 1280, 256
_QUALITY = 90
_NEAR_MM = 10.0
_TOLERANCE_PX = 0.6


@dataclass(frozen=True)
class Drawn:
    """What was drawn of an image.

    Attributes:
        digest: of everything that the drawing depends on.
        files: its files, relative to the folder of the pages.
    """

    digest: str
    files: tuple[str, ...]


@dataclass(frozen=True)
class ImageTask:
    """An image on its way to a worker process.

    Attributes:
        image: what the dataset says of it; every instance has a label and visibility.
        recorded: how it was made, if that was recorded.
        infos: models_info.json of the objects in it.
        symmetries: symmetries.json, if instances have a ``quasi``.
        size_px: width and height, if camera.json says them; used where there is no picture.
        to: the folder to write to.
        pages: where that folder will be when it is whole: links to the dataset's own pictures begin there.
        copy: have copies of those pictures instead of links.
        former: what a former preview in ``pages`` has of the image.
    """

    image: Image
    recorded: ImageSpec | None
    infos: Mapping[int, ModelInfo]
    symmetries: SymmetryTable | None
    size_px: tuple[int, int] | None
    to: Path
    pages: Path
    copy: bool
    former: Drawn | None

    @property
    def key(self) -> str:
        return image_key(self.image)


def image_key(image: Image) -> str:
    """What the pages call an image: SCENE/IMAGE."""
    return f"{image.paths.root.name}/{image.im_id:06d}"


def write_image(task: ImageTask) -> Drawn:
    """Write the files of an image into the folder of the pages, or take over those of a former preview.

    Raises:
        UserError: a file of the dataset is damaged, or one of the pages cannot be written.
    """
    digest = _digest(task)
    if task.former is not None and task.former.digest == digest and _taken_over(task, task.former):
        return task.former
    return Drawn(digest, tuple(_draw(task)))


def _digest(task: ImageTask) -> str:
    """Of what the labels say, and of which files the pictures are; a file is known by its size and time."""
    image = task.image
    said = [
        [
            [each.gt_id, each.obj_id, each.R_m2c.tolist(), each.t_m2c.tolist()],
            [_plain(each.label), _plain(each.visibility)],
            [each.quasi is not None, [(R.tolist(), t.tolist()) for R, t in _alike(each, task.symmetries)]],
        ]
        for each in image.instances
    ]
    paths = [image.paths.find_rgb(image.im_id), image.paths.depth(image.im_id), image.paths.normals(image.im_id)]
    for each in image.instances:
        paths += [of(image.im_id, each.gt_id) for of in (image.paths.mask, image.paths.mask_visib)]
    files = [_identity(path) for path in paths if path is not None]
    link = None if task.copy or paths[0] is None else _link(task, paths[0])
    whole = [_DRAWING, image.K.tolist(), said, repr(task.recorded), repr(task.infos), task.size_px, files, link]
    return hashlib.sha256(repr(whole).encode()).hexdigest()[:32]


def _plain(record: Any) -> dict[str, Any]:
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in vars(record).items()}


def _identity(path: Path) -> tuple[str, int, int] | None:
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return path.name, found.st_size, found.st_mtime_ns


def _taken_over(task: ImageTask, former: Drawn) -> bool:
    """Give the files of a former preview a place in the new one; whether all were there."""
    if not all((task.pages / name).is_file() for name in former.files):
        return False
    for name in former.files:
        link_or_copy(task.pages / name, task.to / name)
    return True


def _draw(task: ImageTask) -> Iterator[str]:
    """Write an image's files; gives the name of each."""
    depth, depth_mm = _depth_view(task.image)
    found = {"rgb": _rgb_view(task.image), "depth": depth, "normals": _normals_view(task.image)}
    views = {name: pixels for name, pixels in found.items() if pixels is not None}
    shown = {name: f"images/{task.key}-{name}.jpg" for name in views}
    picture = task.image.paths.find_rgb(task.image.im_id)
    if picture is not None and not task.copy:
        shown["rgb"] = _link(task, picture)
    for name, pixels in views.items():
        if shown[name].startswith("images/"):
            yield from _file(task, shown[name], _encode(pixels, _LARGEST_PX))
    best = next(iter(views.values()), None)
    width, height = _size_px(task) if best is None else best.shape[1::-1]
    thumbnail = np.full((height, width, 3), _GREY) if best is None else best
    yield from _file(task, f"thumbnails/{task.key}.jpg", _encode(thumbnail, _THUMBNAIL_PX))
    content = {
        "size": [width, height],
        "sections": _sections(task.image, task.recorded),
        "instances": [_instance(task, instance) for instance in task.image.instances],
        "views": shown,
        "depth_mm": depth_mm,
    }
    script = f"synthetless.arrived({json.dumps(task.key)}, {json.dumps(content, allow_nan=False)});\n"
    yield from _file(task, f"data/{task.key}.js", script.encode())


def _file(task: ImageTask, name: str, content: bytes) -> Iterator[str]:
    atomic_write(task.to / name, content)
    yield name


def _link(task: ImageTask, picture: Path) -> str:
    """From the pages to a picture of the dataset, as an address: whatever the folders are called."""
    return quote(os.path.relpath(picture.resolve(), task.pages.resolve()))


def _size_px(task: ImageTask) -> tuple[int, int]:
    if task.size_px is None:
        raise UserError(
            f"{task.image.paths.root}: image {task.image.im_id} has no picture, and {CAMERA_FILE} does not say its size"
        )
    return task.size_px


def _instance(task: ImageTask, instance: Instance) -> dict[str, Any]:
    label, seen, model = instance.label, instance.visibility, task.infos[instance.obj_id]
    assert label is not None and seen is not None  # see ImageTask
    image, paths = task.image, task.image.paths
    masks = {"visible": paths.mask_visib, "amodal": paths.mask}
    existing = {name: path for name, of in masks.items() if (path := of(instance.im_id, instance.gt_id)).exists()}
    return {
        "gt": instance.gt_id,
        "obj": instance.obj_id,
        "visib": round(seen.visib_fract, 4),
        "regressor": label.regressor_index,
        "regressors": label.n_regressors,
        "margin": round(label.discontinuity_margin_deg, 2),
        "distance": round(float(np.linalg.norm(instance.t_m2c)), 1),
        "place": _place(seen),
        "material": _material(task.recorded, instance.gt_id),
        "outlines": {name: outline(images.decode_mask(read_bytes(path), path)) for name, path in existing.items()},
        "true": _pose(image, instance.R_m2c, instance.t_m2c, model),
        "canonical": _pose(image, label.R_m2c, label.t_m2c, model),
        "cosets": 0 if instance.quasi is None else len(instance.quasi.alike),
        "alike": [_pose(image, R, t, model) for R, t in _alike(instance, task.symmetries)],
    }


def _alike(instance: Instance, symmetries: SymmetryTable | None) -> Iterator[tuple[Floats, Floats]]:
    """A pose of each coset that the image cannot tell from the true one, without that one."""
    if instance.quasi is None or symmetries is None:
        return
    entry = symmetries.entries[instance.obj_id]
    assert entry.quasi is not None  # or the label would not be of this table
    cosets = Cosets.of(entry.quasi.group, entry.group)
    true, Rs, ts = cosets.candidates(instance.R_m2c, instance.t_m2c, instance.quasi.R_m2c)
    yield from ((Rs[number], ts[number]) for number in np.flatnonzero(instance.quasi.alike) if number != true)


def _pose(image: Image, R_m2c: Floats, t_m2c: Floats, model: ModelInfo) -> dict[str, list[Segment]]:
    return {
        "box": box_lines(image.K, R_m2c, t_m2c, box_corners_mm(model), image.distortion),
        "axes": axis_lines(image.K, R_m2c, t_m2c, 0.5 * float(model["diameter"]), image.distortion),
    }


def _place(seen: Visibility) -> list[float]:
    """Where an instance's words are written: the middle of its visible box; nowhere if it is hidden."""
    x, y, w, h = seen.bbox_visib
    return [] if w < 0 else [x + w / 2, y + h / 2]


# Pictures


def _rgb_view(image: Image) -> Pixels | None:
    return image.rgb() if image.paths.find_rgb(image.im_id) else None


def _depth_view(image: Image) -> tuple[Pixels | None, list[float]]:
    """Depth as colours, near ones bright, black where there is none; and its range [near, far] in mm.

    The farthest fiftieth of the pixels, often a table's horizon, has one colour.
    """
    if not image.paths.depth(image.im_id).exists():
        return None, []
    depth_mm = image.depth_mm()
    present = depth_mm > 0
    if not present.any():
        return np.zeros((*depth_mm.shape, 3), np.uint8), []
    near, far = np.percentile(depth_mm[present], [0.0, 98.0]).tolist()
    level = np.clip((far - depth_mm) / max(far - near, 1e-6), 0, 1)
    colours = cv2.applyColorMap(np.rint(255 * level).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(present[..., None], colours, 0).astype(np.uint8), [round(near, 1), round(far, 1)]


def _normals_view(image: Image) -> Pixels | None:
    """Unit normals as colours: x red, y green, z blue, each 0 at -1 and 255 at 1; black where there is none."""
    if not image.paths.normals(image.im_id).exists():
        return None
    vectors = image.normals()
    colours = np.where(vectors.any(axis=2)[..., None], 127.5 + 127.5 * vectors, 0)
    pixels: Pixels = np.rint(colours).astype(np.uint8)
    return pixels


def _encode(pixels: Pixels, largest_px: int) -> bytes:
    """A JPEG of which no side is longer than ``largest_px``."""
    height, width = pixels.shape[:2]
    scale = min(1.0, largest_px / max(height, width))
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return images.encode_jpeg(np.ascontiguousarray(pixels), _QUALITY)


# Labels as lines


def outline(mask: NDArray[np.bool_]) -> str:
    """The border of a mask as an SVG path, holes included (fill-rule evenodd); "" for an empty mask.

    It runs through the centres of the border pixels, simplified by at most 0.6 pixels.
    """
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return "".join(_closed(cv2.approxPolyDP(contour, _TOLERANCE_PX, True).reshape(-1, 2)) for contour in contours)


def _closed(points: NDArray[Any]) -> str:
    return "M" + "L".join(f"{u} {v}" for u, v in points.tolist()) + "Z"


def box_lines(
    K: Floats, R_m2c: Floats, t_m2c: Floats, corners_mm: Floats, distortion: Floats | None = None
) -> list[Segment]:
    """The twelve edges of a box in the image; parts behind the camera are cut off, and a lens bends none of them.

    Args:
        K: (3, 3) camera matrix, pixels.
        R_m2c, t_m2c: pose, (3, 3) and (3,) mm.
        corners_mm: (8, 3), in the order of ``labels.box_corners_mm``.
        distortion: (5,) of the lens; None for a pinhole.

    Returns:
        [u, v, u', v'] of each edge that is at least partly before the camera.
    """
    return _lines(K, distortion, corners_mm @ R_m2c.T + t_m2c, BOX_EDGES)


def axis_lines(
    K: Floats, R_m2c: Floats, t_m2c: Floats, length_mm: float, distortion: Floats | None = None
) -> list[Segment]:
    """The model frame's x, y and z axis in the image, each from the origin, as ``box_lines``.

    The list is empty unless the origin and all three ends are before the camera: an axis has its colour by its place.
    """
    ends = np.vstack([np.zeros(3), length_mm * np.eye(3)]) @ R_m2c.T + t_m2c
    return _lines(K, distortion, ends, ((0, 1), (0, 2), (0, 3))) if (ends[:, 2] > _NEAR_MM).all() else []


def _lines(K: Floats, distortion: Floats | None, points_mm: Floats, pairs: Sequence[tuple[int, int]]) -> list[Segment]:
    clipped = (_before_camera(points_mm[a], points_mm[b]) for a, b in pairs)
    return [np.round(project(ends, K, distortion), 1).ravel().tolist() for ends in clipped if ends is not None]


def _before_camera(a: Floats, b: Floats) -> Floats | None:
    """The part (2, 3) of a segment that is farther than the near plane."""
    if max(a[2], b[2]) <= _NEAR_MM:
        return None
    if min(a[2], b[2]) <= _NEAR_MM:
        cut = a + (b - a) * ((_NEAR_MM - a[2]) / (b[2] - a[2]))
        a, b = (cut, b) if a[2] <= _NEAR_MM else (a, cut)
    return np.stack([a, b])


# The recorded scene in words


def _sections(image: Image, recorded: ImageSpec | None) -> list[Section]:
    """What was drawn for an image: {"title", "rows"}, a row being [name, value] or [name, value, CSS colour]."""
    K, lens = image.K, image.distortion
    pinhole = [
        ["focal lengths", f"{K[0, 0]:.2f}, {K[1, 1]:.2f} px"],
        ["principal point", f"{K[0, 2]:.2f}, {K[1, 2]:.2f} px"],
        *([["k1, k2, p1, p2, k3", ", ".join(f"{value:g}" for value in lens)]] if lens.any() else []),
    ]
    if recorded is None:
        return [{"title": "Camera", "rows": pinhole}]
    spec = recorded.scene
    return [
        {"title": "Camera", "rows": _view_rows(spec.views[recorded.view]) + pinhole},
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
        *([] if spec.room is None else [{"title": "Room", "rows": _room_rows(spec.room)}]),
        *([] if spec.environment is None else [{"title": "Panorama", "rows": _environment_rows(spec.environment)}]),
        {"title": "Table", "rows": _plane_rows(spec.plane)},
        {
            "title": "Drop",
            "rows": [
                ["drop", str(spec.drop)],
                ["throw", str(spec.attempt + 1)],
                ["view", f"{recorded.view + 1} of {len(spec.views)}"],
                ["objects dropped", str(len(spec.objects))],
            ],
        },
        *([] if recorded.sensor is None else [{"title": "Sensor", "rows": _sensor_rows(recorded.sensor)}]),
        *([] if recorded.depth_sensor is None else [{"title": "Depth", "rows": _depth_rows(recorded.depth_sensor)}]),
    ]


def _view_rows(view: View) -> list[list[str]]:
    return [
        ["distance", f"{view.distance_m:.3f} m"],
        ["elevation", f"{view.elevation_deg:.1f}°"],
        ["azimuth", f"{view.azimuth_deg:.1f}°"],
        ["roll", f"{view.roll_deg:.1f}°"],
    ]


def _plane_rows(plane: PlaneSpec) -> list[list[str]]:
    texture = plane.texture
    words = texture.file if isinstance(texture, PhotoTexture) else f"{texture.family}, seed {texture.seed}"
    return [
        ["texture", words],
        ["tile", f"{plane.tile_m:.2f} m, turned {plane.rotation_deg:.0f}°"],
        ["roughness", f"{plane.roughness:.2f}"],
        ["specular", f"{plane.specular:.2f}"],
    ]


def _room_rows(room: RoomSpec) -> list[list[str]]:
    sides = [("ceiling", room.ceiling), *((f"wall {k}", wall) for k, wall in enumerate(room.walls, start=1))]
    return [
        ["size", f"{room.side_m:.2f} m, {room.height_m:.2f} m high"],
        *([name, " ".join(f"{channel:.2f}" for channel in radiance), _hex(radiance)] for name, radiance in sides),
        *(
            [f"soft lamp {k}", f"strength {lamp.strength:.2f}, radius {lamp.radius_m:.2f} m", _hex(lamp.color)]
            for k, lamp in enumerate(room.lamps, start=1)
        ),
    ]


def _environment_rows(environment: EnvironmentSpec) -> list[list[str]]:
    return [
        ["panorama", environment.file],
        ["turn", f"{environment.turn_deg:.1f}°"],
        ["strength", f"{environment.strength:.2f}"],
    ]


def _depth_rows(sensor: DepthSensorSpec) -> list[list[str]]:
    disparity = sensor.disparity_step_px > 0 and sensor.baseline_m != 0
    beyond = f"{sensor.noise_growth_mm:.2f} mm per m{'²' if sensor.noise_order == 2 else ''}"
    return [
        ["projector", f"{1000 * sensor.baseline_m:.0f} mm to the right"],
        ["axial noise", f"{sensor.noise_mm:.2f} mm, {beyond} beyond {sensor.noise_from_m:.2f} m"],
        ["lateral noise", f"{sensor.lateral_px:.2f} px, {sensor.edges} edges"],
        ["steps", f"{sensor.disparity_step_px:.3f} px of disparity" if disparity else f"{sensor.step_mm:.2f} mm"],
        ["grazing from", f"{sensor.grazing_deg:.1f}°"],
        ["dark below", f"albedo {sensor.dark:.3f}"],
    ]


def _sensor_rows(sensor: SensorSpec) -> list[list[str]]:
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


def _material(recorded: ImageSpec | None, gt_id: int) -> list[str]:
    """[words, CSS colour] of a labelled instance's material; nothing if it was not recorded."""
    if recorded is None:
        return []
    made_of: Material = recorded.scene.objects[recorded.instances[gt_id]].material
    colour = _hex(made_of.albedo)
    shown = colour if made_of.colour == "grey" else "colours of the model"
    words = f"{shown}, roughness {made_of.roughness:.2f}, specular {made_of.specular:.2f}"
    return [words + (f", metallic {made_of.metallic:.2f}" if made_of.metallic else ""), colour]


def _hex(linear: Vector) -> str:
    displayed = srgb_from_linear(np.array(linear, dtype=np.float32))
    red, green, blue = np.rint(255 * displayed).astype(int).tolist()
    return f"#{red:02x}{green:02x}{blue:02x}"
