"""Damages to image files and to the folders they are in."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from damage_kit import CUT, HIDDEN, IMAGE, OTHER, WHOLE, Victim, damage, fringe
from numpy.typing import NDArray

from synthetless.annotation.instances import PosedModel
from synthetless.annotation.scene import scene_caster
from synthetless.dataset.records import read_scene_json
from synthetless.io.images import encode_mask
from synthetless.io.models import load_models
from synthetless.scenes.spec import Intrinsics


def _name(folder: str, instance: int | None = None) -> str:
    return f"{folder}/{IMAGE:06d}" + ("" if instance is None else f"_{instance:06d}") + ".png"


def _negative(pixels: NDArray[Any]) -> NDArray[Any]:
    return 255 - pixels


# --- files ---


@damage("unreadable", _name("rgb"), IMAGE)
def truncated_png(victim: Victim) -> None:
    data = victim.rgb.read_bytes()
    victim.rgb.write_bytes(data[: len(data) // 2])


@damage("unreadable", _name("rgb"), IMAGE)
def png_without_its_last_byte(victim: Victim) -> None:
    victim.rgb.write_bytes(victim.rgb.read_bytes()[:-1])


@damage("unreadable", _name("rgb"), IMAGE)
def one_bit_flipped(victim: Victim) -> None:
    data = bytearray(victim.rgb.read_bytes())
    data[len(data) // 2] ^= 1
    victim.rgb.write_bytes(data)


@damage("unreadable", _name("rgb"), IMAGE)
def zero_byte_image(victim: Victim) -> None:
    victim.rgb.write_bytes(b"")


@damage("unreadable", _name("rgb"), IMAGE)
def a_page_of_html(victim: Victim) -> None:
    victim.rgb.write_bytes(b"<html>404</html>")


@damage("missing", _name("rgb"), IMAGE)
def missing_image(victim: Victim) -> None:
    victim.rgb.unlink()


@damage("missing", _name("depth"), IMAGE)
def missing_depth(victim: Victim) -> None:
    victim.depth.unlink()


@damage("missing", _name("mask_visib", WHOLE), IMAGE, WHOLE)
def missing_mask(victim: Victim) -> None:
    victim.visible().unlink()


@damage("missing", _name("mask", WHOLE), IMAGE, WHOLE)
def missing_folder(victim: Victim) -> None:
    shutil.rmtree(victim.scene.root / "mask")


@damage("picture", _name("rgb"), IMAGE)
def image_of_another_size(victim: Victim) -> None:
    victim.repaint(victim.rgb, lambda pixels: pixels[:, :-1])


@damage("picture", _name("rgb"), IMAGE)
def grey_image(victim: Victim) -> None:
    victim.repaint(victim.rgb, lambda pixels: pixels[..., 0])


@damage("stray", "rgb/000003.png", 3)
def image_of_no_labels(victim: Victim) -> None:
    shutil.copy(victim.rgb, victim.scene.rgb(3))


@damage("stray", "mask/000001_000006.png", IMAGE, 6)
def mask_of_no_instance(victim: Victim) -> None:
    shutil.copy(victim.mask(), victim.mask(6))


@damage("stray", "rgb/.000001.png.77.part")
def leftover_of_an_interrupted_write(victim: Victim) -> None:
    (victim.scene.root / "rgb/.000001.png.77.part").write_bytes(b"\x89PNG")


@damage("stray", "normals")
def files_that_nobody_asked_for(victim: Victim) -> None:
    (victim.scene.root / "normals").mkdir()


@damage("stray", "/train_synthetless/000009")
def stray_scene_folder(victim: Victim) -> None:
    shutil.copytree(victim.scene.root, victim.scene.root.parent / "000009")


@damage("missing", "/train_synthetless/000002")
def missing_scene_folder(victim: Victim) -> None:
    shutil.rmtree(victim.scene.root.parent / "000002")


# --- depth ---


@damage("depth", _name("depth"), IMAGE)
def depth_in_other_units(victim: Victim) -> None:
    victim.repaint(victim.depth, lambda pixels: (pixels // 10).astype(np.uint16))


@damage("depth", _name("depth"), IMAGE)
def depth_of_another_image(victim: Victim) -> None:
    shutil.copy(victim.scene.depth(2), victim.depth)


@damage("depth", _name("depth"), IMAGE, WHOLE)
def hole_in_the_depth(victim: Victim) -> None:
    visible = cv2.imread(str(victim.visible()), cv2.IMREAD_UNCHANGED) > 0
    victim.repaint(victim.depth, lambda pixels: np.where(visible, 0, pixels).astype(np.uint16))


@damage("depth", _name("depth"), IMAGE)
def distance_along_the_ray_instead_of_depth(victim: Victim) -> None:
    def stretch(pixels: NDArray[Any]) -> NDArray[Any]:
        u, v = np.meshgrid(np.arange(128), np.arange(96))
        length = np.sqrt(1 + ((u - 63.2) / 300) ** 2 + ((v - 47.7) / 298) ** 2)
        stretched: NDArray[Any] = np.rint(pixels * length).astype(np.uint16)
        return stretched

    victim.repaint(victim.depth, stretch)


@damage("picture", _name("depth"), IMAGE)
def depth_of_eight_bits(victim: Victim) -> None:
    victim.repaint(victim.depth, lambda pixels: (pixels >> 8).astype(np.uint8))


@damage("depth", _name("depth"), IMAGE)
def depth_shifted_by_a_pixel(victim: Victim) -> None:
    victim.repaint(victim.depth, lambda pixels: np.roll(pixels, 1, axis=1))


@damage("depth", _name("depth"), IMAGE)
def one_pixel_of_depth_off_by_half_a_millimetre(victim: Victim) -> None:
    def push(pixels: NDArray[Any]) -> NDArray[Any]:
        pixels[2, 3] += 5
        return pixels

    victim.repaint(victim.depth, push)


@damage("depth", _name("depth"), IMAGE, WHOLE, deep=True)
def dent_in_an_object(victim: Victim) -> None:
    visible = cv2.imread(str(victim.visible()), cv2.IMREAD_UNCHANGED) > 0
    core = cv2.erode(visible.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    victim.repaint(victim.depth, lambda pixels: np.where(core, pixels + 5, pixels).astype(np.uint16))


# --- masks ---


@damage("gt_info", "scene_gt_info.json", IMAGE, WHOLE)
def mask_of_another_instance(victim: Victim) -> None:
    shutil.copy(victim.mask(OTHER), victim.mask(WHOLE))


@damage("mask", _name("mask_visib", WHOLE), IMAGE, WHOLE)
def visible_mask_of_another_instance(victim: Victim) -> None:
    shutil.copy(victim.visible(OTHER), victim.visible(WHOLE))


@damage("gt_info", "scene_gt_info.json", IMAGE, WHOLE)
def swapped_masks(victim: Victim) -> None:
    for path_of in (victim.mask, victim.visible):
        first, second = path_of(WHOLE).read_bytes(), path_of(OTHER).read_bytes()
        path_of(WHOLE).write_bytes(second)
        path_of(OTHER).write_bytes(first)


def _silhouette(victim: Victim, instance: int, shift_px: float) -> NDArray[np.bool_]:
    """An instance's silhouette under a principal point that is off, as by a wrong convention of pixel centres."""
    pose = read_scene_json(victim.scene.scene_gt)[IMAGE][instance]
    models = load_models(victim.root / "models", (pose["obj_id"],))
    caster = scene_caster({"model": models})
    camera = Intrinsics(128, 96, 300.0, 298.0, 63.2 + shift_px, 47.7 + shift_px)
    posed = PosedModel(pose["obj_id"], np.reshape(pose["cam_R_m2c"], (3, 3)), np.array(pose["cam_t_m2c"]))
    return caster.annotate(camera, None, [posed]).instances[0].mask


@damage("gt_info", "scene_gt_info.json", IMAGE, WHOLE)
def mask_shifted_by_half_a_pixel(victim: Victim) -> None:
    victim.mask().write_bytes(encode_mask(_silhouette(victim, WHOLE, 0.5)))


@damage("coco", "scene_gt_coco.json", IMAGE, WHOLE)
def visible_mask_shifted_by_half_a_pixel(victim: Victim) -> None:
    victim.visible().write_bytes(encode_mask(_silhouette(victim, WHOLE, 0.5)))


@damage("gt_info", "scene_gt_info.json", IMAGE, CUT)
def mask_of_a_cut_instance_shifted_by_half_a_pixel(victim: Victim) -> None:
    victim.mask(CUT).write_bytes(encode_mask(_silhouette(victim, CUT, 0.5)))


@damage("gt_info", "scene_gt_info.json", IMAGE, WHOLE)
def inverted_mask(victim: Victim) -> None:
    victim.repaint(victim.mask(), _negative)


@damage("picture", _name("mask", WHOLE), IMAGE, WHOLE)
def mask_of_zeros_and_ones(victim: Victim) -> None:
    victim.repaint(victim.mask(), lambda pixels: pixels // 255)


@damage("picture", _name("mask", WHOLE), IMAGE, WHOLE)
def blurred_mask(victim: Victim) -> None:
    victim.repaint(victim.mask(), lambda pixels: cv2.GaussianBlur(pixels, (5, 5), 1.0))


@damage("picture", _name("mask", WHOLE), IMAGE, WHOLE)
def mask_of_another_size(victim: Victim) -> None:
    victim.repaint(victim.mask(), lambda pixels: pixels.T)


def _add_pixel(where: NDArray[np.bool_]) -> Any:
    row, column = (places[0] for places in np.nonzero(where))

    def add(pixels: NDArray[Any]) -> NDArray[Any]:
        pixels[row, column] = 255
        return pixels

    return add


@damage("mask", _name("mask_visib", WHOLE), IMAGE, WHOLE)
def visible_pixel_outside_the_silhouette(victim: Victim) -> None:
    mask = cv2.imread(str(victim.mask()), cv2.IMREAD_UNCHANGED)
    victim.repaint(victim.visible(), _add_pixel(fringe(mask)))


@damage("mask", _name("mask_visib", HIDDEN), IMAGE, HIDDEN)
def pixel_of_two_instances(victim: Victim) -> None:
    """A pixel of the silhouette that another instance hides, declared visible of both."""
    others = [cv2.imread(str(victim.visible(i)), cv2.IMREAD_UNCHANGED) for i in range(HIDDEN)]
    silhouette = cv2.imread(str(victim.mask(HIDDEN)), cv2.IMREAD_UNCHANGED)
    victim.repaint(victim.visible(HIDDEN), _add_pixel((np.max(others, axis=0) > 0) & (silhouette > 0)))


@damage("mask", _name("mask_visib", WHOLE), IMAGE, WHOLE)
def instance_declared_invisible(victim: Victim) -> None:
    """Consistently in every file: only the depth knows better."""
    empty = encode_mask(np.zeros((96, 128), dtype=bool))
    victim.visible().write_bytes(empty)
    with victim.entry("gt_info", WHOLE) as info:
        info |= {"px_count_visib": 0, "visib_fract": 0.0, "bbox_obj": [-1] * 4, "bbox_visib": [-1] * 4}
    with victim.json(victim.scene.scene_gt_coco) as content:
        ids: Sequence[int] = [a["id"] for a in content["annotations"] if a["image_id"] == IMAGE]
        content["annotations"] = [a for a in content["annotations"] if a["id"] != ids[WHOLE]]


@damage("mask", _name("mask", HIDDEN), IMAGE, HIDDEN, deep=True)
def mask_that_lacks_a_hidden_part(victim: Victim) -> None:
    """Pixels that nobody sees, taken away within the box and counted so."""
    visible = cv2.imread(str(victim.visible(HIDDEN)), cv2.IMREAD_UNCHANGED) > 0
    silhouette = cv2.imread(str(victim.mask(HIDDEN)), cv2.IMREAD_UNCHANGED) > 0
    inner = cv2.erode(silhouette.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    left = silhouette & ~(inner & ~visible)
    victim.mask(HIDDEN).write_bytes(encode_mask(left))
    with victim.entry("gt_info", HIDDEN) as info:
        info["px_count_all"] = info["px_count_valid"] = int(left.sum())
        info["visib_fract"] = info["px_count_visib"] / info["px_count_all"]
