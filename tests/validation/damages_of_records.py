"""Damages to the records, to scene_spec.jsonl and to scene_gt_coco.json."""

from __future__ import annotations

import shutil

from damage_kit import IMAGE, OTHER, WHOLE, Victim, damage

from synthetless.dataset.layout import RECORDS_FOLDER

RECORD = f"{RECORDS_FOLDER}/000001/{IMAGE:06d}.json"
GT, COCO, SPEC = "scene_gt.json", "scene_gt_coco.json", "scene_spec.jsonl"


# --- .records ---


@damage("missing", f"/{RECORD}", IMAGE)
def lost_record(victim: Victim) -> None:
    (victim.root / RECORD).unlink()


@damage("unreadable", f"/{RECORD}", IMAGE)
def record_of_zero_bytes(victim: Victim) -> None:
    (victim.root / RECORD).write_bytes(b"")


@damage("record", f"/{RECORD}", IMAGE)
def record_of_another_pose(victim: Victim) -> None:
    with victim.json(victim.root / RECORD) as record:
        record["gt"][WHOLE]["cam_t_m2c"][2] += 1.0


@damage("record", f"/{RECORD}", IMAGE)
def record_that_lacks_its_counts(victim: Victim) -> None:
    with victim.json(victim.root / RECORD) as record:
        del record["gt_info"]


@damage("unreadable", f"/{RECORD}", IMAGE)
def record_that_is_a_list(victim: Victim) -> None:
    (victim.root / RECORD).write_text("[1, 2]")


@damage("record", f"/{RECORD}", IMAGE)
def record_of_another_scene(victim: Victim) -> None:
    with victim.json(victim.root / RECORD) as record:
        record["spec"]["scene"]["light"]["power_w"] = 1.0


@damage("record", f"/{RECORD}", IMAGE)
def record_without_an_annotation(victim: Victim) -> None:
    with victim.json(victim.root / RECORD) as record:
        record["coco"].pop()


@damage("stray", f"/{RECORDS_FOLDER}/000001/000001 copy.json")
def copy_of_a_record(victim: Victim) -> None:
    shutil.copy(victim.root / RECORD, victim.root / RECORDS_FOLDER / "000001/000001 copy.json")


@damage("stray", f"/{RECORDS_FOLDER}/000001/000003.json")
def record_of_an_image_that_was_not_asked_for(victim: Victim) -> None:
    shutil.copy(victim.root / RECORD, victim.root / RECORDS_FOLDER / "000001/000003.json")


@damage("stray", f"/{RECORDS_FOLDER}/000001/.DS_Store")
def record_of_a_file_manager(victim: Victim) -> None:
    (victim.root / RECORDS_FOLDER / "000001/.DS_Store").write_bytes(b"Bud1")


@damage("stray", f"/{RECORDS_FOLDER}/.DS_Store")
def folder_of_records_of_a_file_manager(victim: Victim) -> None:
    (victim.root / RECORDS_FOLDER / ".DS_Store").write_bytes(b"Bud1")


# --- scene_spec.jsonl ---


@damage("missing", SPEC, IMAGE)
def image_without_record(victim: Victim) -> None:
    with victim.specs() as lines:
        del lines[IMAGE]


@damage("pose", GT, IMAGE, WHOLE)
def record_of_another_fall(victim: Victim) -> None:
    with victim.specs() as lines:
        record = lines[IMAGE]
        record["settled"][record["instances"][WHOLE]]["position_m"][2] += 1e-4


@damage("spec", SPEC, IMAGE)
def record_of_another_view(victim: Victim) -> None:
    with victim.specs() as lines:
        lines[IMAGE]["view"] = 1 - lines[IMAGE]["view"]


@damage("spec", SPEC, IMAGE)
def swapped_records(victim: Victim) -> None:
    with victim.specs() as lines:
        lines[IMAGE]["image_id"], lines[2]["image_id"] = 2, IMAGE


@damage("ids", SPEC, IMAGE)
def record_that_occurs_twice(victim: Victim) -> None:
    with victim.specs() as lines:
        lines.append(lines[IMAGE])


@damage("spec", SPEC, IMAGE, WHOLE)
def instances_in_another_order(victim: Victim) -> None:
    with victim.specs() as lines:
        shown = lines[IMAGE]["instances"]
        shown[WHOLE], shown[5] = shown[5], shown[WHOLE]


@damage("spec", SPEC, IMAGE)
def record_of_a_black_image(victim: Victim) -> None:
    with victim.specs() as lines:
        lines[IMAGE]["exposure_gain"] = 0


@damage("schema", SPEC, IMAGE)
def record_without_light(victim: Victim) -> None:
    with victim.specs() as lines:
        del lines[IMAGE]["scene"]["light"]


@damage("unreadable", SPEC)
def truncated_record(victim: Victim) -> None:
    text = victim.scene.scene_spec.read_text()
    victim.scene.scene_spec.write_text(text[: len(text) - 40])


# --- scene_gt_coco.json ---


@damage("ids", COCO, IMAGE)
def duplicated_annotation_id(victim: Victim) -> None:
    with victim.annotation(WHOLE) as annotation:
        annotation["id"] += 1


@damage("coco", COCO, IMAGE)
def missing_annotation(victim: Victim) -> None:
    with victim.json(victim.scene.scene_gt_coco) as content:
        content["annotations"] = [a for a in content["annotations"] if a["image_id"] != IMAGE or a["category_id"] != 3]


@damage("coco", COCO, IMAGE, WHOLE)
def annotation_box_without_its_last_column(victim: Victim) -> None:
    with victim.annotation(WHOLE) as annotation:
        annotation["bbox"][2] -= 1


@damage("coco", COCO, IMAGE, WHOLE)
def segmentation_of_another_instance(victim: Victim) -> None:
    with victim.annotation(OTHER) as other:
        segmentation = other["segmentation"]
    with victim.annotation(WHOLE) as annotation:
        annotation["segmentation"] = segmentation


@damage("coco", COCO, IMAGE, WHOLE)
def segmentation_that_begins_with_ones(victim: Victim) -> None:
    with victim.annotation(WHOLE) as annotation:
        annotation["segmentation"]["counts"].insert(0, 0)


@damage("coco", COCO, IMAGE, WHOLE)
def segmentation_that_ends_early(victim: Victim) -> None:
    with victim.annotation(WHOLE) as annotation:
        annotation["segmentation"]["counts"].pop()


@damage("coco", COCO, IMAGE, WHOLE)
def wrong_area(victim: Victim) -> None:
    with victim.annotation(WHOLE) as annotation:
        annotation["area"] -= 1


@damage("coco", COCO, IMAGE, WHOLE)
def wrong_category(victim: Victim) -> None:
    with victim.annotation(WHOLE) as annotation:
        annotation["category_id"] = 3


@damage("coco", COCO, IMAGE, WHOLE)
def ignored_for_no_reason(victim: Victim) -> None:
    with victim.annotation(WHOLE) as annotation:
        annotation["ignore"] = True


@damage("coco", COCO, IMAGE)
def annotation_of_another_image_file(victim: Victim) -> None:
    with victim.json(victim.scene.scene_gt_coco) as content:
        content["images"][IMAGE]["file_name"] = "rgb/000002.png"


@damage("coco", COCO, IMAGE)
def image_that_is_not_listed(victim: Victim) -> None:
    with victim.json(victim.scene.scene_gt_coco) as content:
        del content["images"][IMAGE]


@damage("coco", COCO)
def categories_of_another_dataset(victim: Victim) -> None:
    with victim.json(victim.scene.scene_gt_coco) as content:
        content["categories"].pop()


@damage("schema", COCO, IMAGE)
def annotation_without_box(victim: Victim) -> None:
    with victim.annotation(WHOLE) as annotation:
        del annotation["bbox"]
