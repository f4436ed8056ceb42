"""Commands that exchange data with others: fetch, export coco and webdataset."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from synthetless.cli.options import AsJson, Split
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
    split: Split = None,
    as_json: AsJson = False,
) -> None:
    """Write one COCO file for the whole split.

    Canonical poses, and box corners as keypoints, are in it.
    """
    from synthetless.dataset.labels import undisturbed
    from synthetless.exports.coco import export_coco

    with undisturbed(dataset, may_grow=True):
        count = export_coco(dataset, to, split, boxes)
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
