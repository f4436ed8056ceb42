"""Commands that exchange data with others: fetch, export coco and webdataset."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from synthetless.cli.options import Split
from synthetless.cli.terminal import say


def fetch_command(
    what: Annotated[Literal["tless", "dtd"], typer.Argument(help="T-LESS CAD models, or Describable Textures.")],
    to: Annotated[Path, typer.Option(metavar="DIR", help="Folder to put them into.")],
    source: Annotated[str | None, typer.Option("--from", help="Archive, folder or address to take them from.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Get the T-LESS models or the Describable Textures.

    They come from where they are published, are checked, and bring their licence.
    """
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
) -> None:
    """Write one COCO file for the whole split.

    Canonical poses, and box corners as keypoints, are in it.
    """
    from synthetless.dataset.labels import undisturbed
    from synthetless.exports.coco import export_coco

    with undisturbed(dataset, may_grow=True):
        count = export_coco(dataset, to, split, boxes)
    say(f"{count} images in {to}")


def webdataset_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    to: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the shards.")],
    images_per_shard: Annotated[int, typer.Option(min=1, metavar="N", help="Images in a shard, at most.")] = 1000,
    shuffle_seed: Annotated[int | None, typer.Option(metavar="N", help="Shuffle the images by this seed.")] = None,
    relabel_only: Annotated[bool, typer.Option("--relabel-only", help="Renew the labels of existing shards.")] = False,
    split: Split = None,
) -> None:
    """Write BOP webdataset shards.

    The labels are in .gt_canonical.json.
    """
    from synthetless.dataset.labels import undisturbed
    from synthetless.exports.webdataset import export_webdataset, relabel_webdataset

    with undisturbed(dataset, may_grow=True):
        if relabel_only:
            relabel_webdataset(dataset, to, split)
            say(f"labels replaced in {to}")
            return
        shards = export_webdataset(dataset, to, split, images_per_shard, shuffle_seed)
    say(f"{len(shards)} images in {len(set(shards.values()))} shards in {to}")
