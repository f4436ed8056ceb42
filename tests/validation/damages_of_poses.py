"""Damages to poses, cameras, counts and boxes, and to the form of the files that hold them."""

from __future__ import annotations

import numpy as np
from damage_kit import HIDDEN, IMAGE, OTHER, WHOLE, Victim, damage

GT, INFO, CANONICAL, CAMERA = "scene_gt.json", "scene_gt_info.json", "scene_gt_canonical.json", "scene_camera.json"


# --- poses ---


@damage("pose", GT, IMAGE, WHOLE)
def swapped_poses(victim: Victim) -> None:
    with victim.entry("gt") as gt:
        for key in ("cam_R_m2c", "cam_t_m2c"):
            gt[WHOLE][key], gt[OTHER][key] = gt[OTHER][key], gt[WHOLE][key]


@damage("pose", GT, IMAGE, WHOLE)
def transposed_rotation(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["cam_R_m2c"] = np.reshape(pose["cam_R_m2c"], (3, 3)).T.ravel().tolist()


@damage("pose", GT, IMAGE, WHOLE)
def rotation_stretched_by_a_millionth(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["cam_R_m2c"] = (np.array(pose["cam_R_m2c"]) * (1 + 1e-6)).tolist()


@damage("pose", GT, IMAGE, WHOLE)
def mirrored_rotation(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["cam_R_m2c"] = (np.reshape(pose["cam_R_m2c"], (3, 3)) * [1, 1, -1]).ravel().tolist()


@damage("pose", GT, IMAGE, WHOLE)
def object_behind_the_camera(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["cam_t_m2c"][2] *= -1


@damage("pose", GT, IMAGE, WHOLE)
def translation_off_by_a_tenth_of_a_millimetre(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["cam_t_m2c"][0] += 0.1


@damage("pose", GT, IMAGE, WHOLE)
def translation_in_metres(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["cam_t_m2c"] = [value / 1000 for value in pose["cam_t_m2c"]]


@damage("ids", CANONICAL, IMAGE, WHOLE)
def another_object(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["obj_id"] = 3


@damage("pose", GT, IMAGE, WHOLE)
def unknown_object(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["obj_id"] = 77


# --- form ---


@damage("schema", GT, IMAGE, WHOLE)
def number_that_is_not_finite(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["cam_t_m2c"][1] = float("nan")


@damage("schema", GT, IMAGE, WHOLE)
def number_as_text(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["obj_id"] = "1"


@damage("schema", GT, IMAGE, WHOLE)
def label_inside_scene_gt(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["regressor_index"] = 0


@damage("schema", GT, IMAGE, WHOLE)
def rotation_of_eight_numbers(victim: Victim) -> None:
    with victim.entry("gt", WHOLE) as pose:
        pose["cam_R_m2c"].pop()


@damage("unreadable", "rgb/000001.png", IMAGE)
def damaged_image_with_damaged_poses(victim: Victim) -> None:
    """Entries that cannot be used must not keep the files of the image from being read."""
    number_as_text(victim)
    victim.rgb.write_bytes(victim.rgb.read_bytes()[:-9])


@damage("unreadable", GT)
def truncated_json(victim: Victim) -> None:
    data = victim.scene.scene_gt.read_bytes()
    victim.scene.scene_gt.write_bytes(data[: len(data) // 2])


@damage("unreadable", CAMERA)
def zero_byte_json(victim: Victim) -> None:
    victim.scene.scene_camera.write_bytes(b"")


@damage("missing", INFO)
def missing_json(victim: Victim) -> None:
    victim.scene.scene_gt_info.unlink()


@damage("unreadable", GT)
def duplicated_image_id(victim: Victim) -> None:
    text = victim.scene.scene_gt.read_text()
    victim.scene.scene_gt.write_text(text.replace('"2":', f'"{IMAGE}":'))


@damage("ids", CANONICAL, IMAGE)
def instance_missing_from_the_labels(victim: Victim) -> None:
    with victim.entry("gt_canonical") as labels:
        labels.pop()


@damage("ids", INFO, IMAGE)
def instance_missing_from_the_poses(victim: Victim) -> None:
    with victim.entry("gt") as gt:
        gt.pop()


@damage("missing", GT, IMAGE)
def image_missing_from_the_poses(victim: Victim) -> None:
    with victim.json(victim.scene.scene_gt) as content:
        del content[str(IMAGE)]


@damage("ids", GT, 7)
def image_that_nobody_asked_for(victim: Victim) -> None:
    with victim.json(victim.scene.scene_gt) as content:
        content["7"] = content[str(IMAGE)]


@damage("ids", GT, IMAGE)
def instance_forgotten_everywhere(victim: Victim) -> None:
    """A visible object without a label is the worst lie to a detector."""
    last = 5
    for name in ("gt", "gt_info", "gt_canonical"):
        with victim.entry(name) as entries:
            del entries[last]
    for path in (victim.mask(last), victim.visible(last)):
        path.unlink()
    with victim.specs() as lines:
        lines[IMAGE]["instances"].pop()


# --- what is counted ---


@damage("gt_info", INFO, IMAGE, WHOLE)
def box_off_by_one(victim: Victim) -> None:
    with victim.entry("gt_info", WHOLE) as info:
        info["bbox_obj"][2] += 1


@damage("gt_info", INFO, IMAGE, HIDDEN)
def visible_box_off_by_one(victim: Victim) -> None:
    with victim.entry("gt_info", HIDDEN) as info:
        info["bbox_visib"][1] -= 1


@damage("gt_info", INFO, IMAGE, 0)
def box_cut_at_the_border(victim: Victim) -> None:
    with victim.entry("gt_info", 0) as info:
        info["bbox_obj"][3] += 20


@damage("gt_info", INFO, IMAGE, WHOLE)
def one_pixel_too_many(victim: Victim) -> None:
    with victim.entry("gt_info", WHOLE) as info:
        info["px_count_all"] += 1
        info["visib_fract"] = info["px_count_visib"] / info["px_count_all"]


@damage("gt_info", INFO, IMAGE, WHOLE)
def one_valid_pixel_too_few(victim: Victim) -> None:
    with victim.entry("gt_info", WHOLE) as info:
        info["px_count_valid"] -= 1


@damage("gt_info", INFO, IMAGE, HIDDEN)
def one_visible_pixel_too_few(victim: Victim) -> None:
    with victim.entry("gt_info", HIDDEN) as info:
        info["px_count_visib"] -= 1
        info["visib_fract"] = info["px_count_visib"] / info["px_count_all"]


@damage("gt_info", INFO, IMAGE, HIDDEN)
def visible_fraction_rounded(victim: Victim) -> None:
    with victim.entry("gt_info", HIDDEN) as info:
        info["visib_fract"] = round(info["visib_fract"], 3)


@damage("gt_info", INFO, IMAGE, WHOLE)
def swapped_infos(victim: Victim) -> None:
    with victim.entry("gt_info") as infos:
        infos[WHOLE], infos[OTHER] = infos[OTHER], infos[WHOLE]


# --- cameras ---


@damage("camera", CAMERA, IMAGE)
def focal_length_of_another_camera(victim: Victim) -> None:
    with victim.entry("camera") as camera:
        camera["cam_K"][0] *= 1.01


@damage("camera", CAMERA, IMAGE)
def principal_point_off_by_half_a_pixel(victim: Victim) -> None:
    with victim.entry("camera") as camera:
        camera["cam_K"][2] += 0.5


@damage("camera", CAMERA, IMAGE)
def wrong_depth_scale(victim: Victim) -> None:
    with victim.entry("camera") as camera:
        camera["depth_scale"] = 1.0


@damage("camera", CAMERA, IMAGE)
def transposed_camera_rotation(victim: Victim) -> None:
    with victim.entry("camera") as camera:
        camera["cam_R_w2c"] = np.reshape(camera["cam_R_w2c"], (3, 3)).T.ravel().tolist()


@damage("camera", CAMERA, IMAGE)
def camera_rotation_that_is_none(victim: Victim) -> None:
    with victim.entry("camera") as camera:
        camera["cam_R_w2c"][4] += 1e-5


@damage("camera", "/camera.json")
def half_a_pixel_in_camera_json(victim: Victim) -> None:
    with victim.json(victim.root / "camera.json") as camera:
        camera["cx"] -= 0.5


@damage("missing", "/camera.json")
def missing_camera_json(victim: Victim) -> None:
    (victim.root / "camera.json").unlink()
