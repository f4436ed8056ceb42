"""A COCO file against the dataset it was made from: every image and annotation, by its id."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pycocotools import mask as coco_mask

from synthetless.exports.coco import export_coco
from synthetless.io.files import read_json
from synthetless.validation.report import Finding, unusable
from synthetless.validation.source import Source

_LISTS = ("images", "annotations", "categories")


def check_coco_export(source: Source, path: Path) -> Iterator[Finding]:
    """Export anew, and compare."""
    try:
        content = read_json(path)
        found = {name: {item["id"]: item for item in content[name]} for name in _LISTS}
    except ValueError as error:
        yield unusable(path, error)
        return
    except (KeyError, TypeError):
        yield Finding("schema", path, f"is no COCO file: it needs the lists {', '.join(_LISTS)}, of objects with ids")
        return
    for name in _LISTS:
        if len(content[name]) != len(found[name]):
            yield Finding("export", path, f"{len(content[name]) - len(found[name])} ids of its {name} occur twice")
    try:
        expected = _export(source)
    except ValueError as error:
        yield Finding("export", path, f"cannot be compared, the dataset cannot be exported: {error}")
        return
    _resolve(found["images"], path.parent)
    _choose_boxes(found["annotations"], expected["annotations"])
    for name in _LISTS:
        yield from _compare(path, name, found[name], expected[name])


def _export(source: Source) -> dict[str, dict[int, Any]]:
    """What an export with amodal boxes says now, by id; files by their absolute paths."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "coco.json"
        export_coco(source.root.resolve(), path, source.recipe.split, "amodal")
        content = json.loads(path.read_bytes())
        by_id = {name: {item["id"]: item for item in content[name]} for name in _LISTS}
        _resolve(by_id["images"], path.parent)
    return by_id


def _choose_boxes(found: Mapping[int, Any], expected: Mapping[int, Any]) -> None:
    """Expect boxes of the visible parts instead, if more of the boxes found are those."""
    visible = {number: coco_mask.toBbox(item["segmentation"]).tolist() for number, item in expected.items()}
    boxes = {number: item.get("bbox") for number, item in found.items() if number in expected}
    n_amodal = sum(box == expected[number]["bbox"] for number, box in boxes.items())
    n_visible = sum(box == visible[number] for number, box in boxes.items())
    if n_visible > n_amodal:
        for number, item in expected.items():
            item["bbox"] = visible[number]


def _resolve(images: Mapping[int, Any], folder: Path) -> None:
    for image in images.values():
        image["file_name"] = str((folder / str(image.get("file_name"))).resolve())


def _compare(path: Path, name: str, found: Mapping[int, Any], expected: Mapping[int, Any]) -> Iterator[Finding]:
    for number in sorted(expected.keys() | found.keys(), key=str):
        if number not in found:
            yield Finding("export", path, f"{name}: id {number} is missing", *_place(name, expected[number]))
        elif number not in expected:
            yield Finding("export", path, f"{name}: id {number} is not in the dataset", *_place(name, found[number]))
        else:
            keys = [
                key
                for key in sorted(expected[number].keys() | found[number].keys())
                if found[number].get(key) != expected[number].get(key)
            ]
            if keys:
                message = f"{name}: id {number} differs from the dataset in {', '.join(keys)}"
                yield Finding("export", path, message, *_place(name, expected[number]))


def _place(name: str, item: Mapping[str, Any]) -> tuple[Any, ...]:
    """Image and instance of an item, numbered as in the file."""
    if name == "images":
        return (item["id"],)
    return (item.get("image_id"), item.get("gt_id")) if name == "annotations" else ()
