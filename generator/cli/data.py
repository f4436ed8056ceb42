"""Commands that exchange data with others: fetch, and the exports."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from synthetless.cli.options import AsJson, Copy, Split
from synthetless.cli.terminal import say

FetchTo = Annotated[Path, typer.Option(metavar="DIR", help="Folder to put them into.")]
FetchFrom = Annotated[
    str | None, typer.Option("--from", metavar="PLACE", help="Archive, folder or address to take them from.")
]


def fetch_tless_command(to: FetchTo, source: FetchFrom = None, as_json: AsJson = False) -> None:
    """Get the 30 CAD models of T-LESS.

    They come from where BOP publishes them, are checked, and bring their licence.
    """
    _fetch("tless", to, source, as_json)


def fetch_dtd_command(to: FetchTo, source: FetchFrom = None, as_json: AsJson = False) -> None:
    """Get the photographs of the Describable Textures, for the table.

    They come from where they are published, are checked, and bring their licence.
    """
    _fetch("dtd", to, source, as_json)


def _fetch(what: Literal["tless", "dtd"], to: Path, source: str | None, as_json: bool) -> None:
    from synthetless.fetch import fetch

    report = fetch(what, to, source)
    if as_json:
        say(json.dumps(asdict(report), default=str))
    else:
        say(f"{report}\n\n{report.licence}\nlicence: {report.licence_file}")


def coco_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    to: Annotated[Path, typer.Option(metavar="FILE", help="JSON file to write.")],
    boxes: Annotated[
        Literal["visible", "amodal"], typer.Option(help="Around the visible pixels, or around the whole object.")
    ] = "visible",
    polygons: Annotated[
        bool, typer.Option("--polygons", help="Masks as polygons, for loaders that know no run lengths.")
    ] = False,
    split: Split = None,
    as_json: AsJson = False,
) -> None:
    """Write one COCO file for the whole split.

    Canonical poses, and box corners as keypoints, are in it.
    """
    from synthetless.dataset.labels import undisturbed
    from synthetless.exports.coco import export_coco

    with undisturbed(dataset, may_grow=True):
        count = export_coco(dataset, to, split, boxes, polygons)
    say(json.dumps({"images": count, "file": str(to)}) if as_json else f"{count} images in {to}")


def webdataset_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    to: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the shards.")],
    images_per_shard: Annotated[int, typer.Option(min=1, metavar="N", help="Images in a shard, at most.")] = 1000,
    shuffle_seed: Annotated[int | None, typer.Option(metavar="N", help="Shuffle the images by this seed.")] = None,
    relabel_only: Annotated[bool, typer.Option("--relabel-only", help="Renew the labels of existing shards.")] = False,
    split: Split = None,
    as_json: AsJson = False,
) -> None:
    """Write BOP webdataset shards.

    The labels are in .gt_canonical.json.
    """
    from synthetless.dataset.labels import undisturbed
    from synthetless.exports.webdataset import export_webdataset, relabel_webdataset

    with undisturbed(dataset, may_grow=True):
        if relabel_only:
            keys = relabel_webdataset(dataset, to, split)
            say(
                json.dumps({"images": len(keys), "shards": len(set(keys.values())), "folder": str(to)})
                if as_json
                else f"labels replaced in {to}"
            )
            return
        shards = export_webdataset(dataset, to, split, images_per_shard, shuffle_seed)
    images, count = len(shards), len(set(shards.values()))
    answer = {"images": images, "shards": count, "folder": str(to)}
    say(json.dumps(answer) if as_json else f"{images} images in {count} shards in {to}")


def yolo_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    to: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")],
    task: Annotated[
        Literal["detect", "segment", "pose"], typer.Option(help="Boxes, outlines, or the 8 canonical box corners.")
    ] = "detect",
    amodal: Annotated[bool, typer.Option("--amodal", help="Of whole objects, hidden parts included.")] = False,
    classes: Annotated[
        Literal["object", "regressor"] | None,
        typer.Option(help="What a class is; default: regressor for pose, else object."),
    ] = None,
    val_percent: Annotated[
        int, typer.Option(min=0, max=50, metavar="PERCENT", help="Images to validate with, whole drops.")
    ] = 10,
    copy: Copy = False,
    split: Split = None,
    as_json: AsJson = False,
) -> None:
    """Write the folder that ultralytics trains YOLO with."""
    from synthetless.dataset.labels import undisturbed
    from synthetless.exports.yolo import DATA_FILE, export_yolo

    with undisturbed(dataset, may_grow=True):
        export_yolo(dataset, to, task, split, amodal, classes, val_percent, copy)
    file = to / DATA_FILE
    say(json.dumps({"task": task, "file": str(file)}) if as_json else f"{task} labels: {file}")


def bop_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    to: Annotated[Path, typer.Option(metavar="DIR", help="Where BOP datasets are; NAME is written into it.")],
    name: Annotated[str, typer.Option("--as", metavar="NAME", help="Of the dataset, as loaders know it.")] = "tless",
    to_split: Annotated[str, typer.Option("--split", metavar="NAME", help="Folder of scenes to write.")] = "train_pbr",
    split: Annotated[str | None, typer.Option("--from-split", metavar="NAME", help="The dataset's own.")] = None,
    jpg: Annotated[int | None, typer.Option(min=1, max=100, metavar="Q", help="JPEG images of this quality.")] = None,
    pixel_centre: Annotated[
        float, typer.Option(metavar="0|0.5", help="0.5 for loaders that subtract half a pixel, or render so.")
    ] = 0.0,
    scenes: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Scene folders; default: 1000 images in each.")
    ] = None,
    xyz_crops: Annotated[bool, typer.Option("--xyz-crops", help="Object coordinates, as GDR-Net reads them.")] = False,
    fps: Annotated[bool, typer.Option("--fps", help="Farthest points of the models, likewise.")] = False,
    depth: Annotated[
        Literal["exact", "sensed"], typer.Option(help="Exact depth, or as a depth camera measures it.")
    ] = "exact",
    copy: Copy = False,
    as_json: AsJson = False,
) -> None:
    """Write a BOP folder as registered loaders expect it."""
    from synthetless.dataset.labels import undisturbed
    from synthetless.exports.bop import export_bop

    with undisturbed(dataset, may_grow=True):
        folder = export_bop(dataset, to, name, to_split, split, jpg, pixel_centre, scenes, xyz_crops, fps, depth, copy)
    say(json.dumps({"folder": str(folder), "split": to_split}) if as_json else f"{to_split} of {name}: {folder}")
