"""Commands of the learning system: score, compare."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from synthetless.cli.options import Split, Workers
from synthetless.config import BUILTIN
from synthetless.errors import UserError


def score_command(
    dataset: Annotated[Path, typer.Argument(help="Folder of a BOP dataset.")],
    results: Annotated[Path, typer.Argument(help="BOP result file: scene_id,im_id,obj_id,score,R,t,time.")],
    errors: Annotated[
        str, typer.Option(metavar="LIST", help="Some of vsd,mssd,mspd; vsd also gives the paper's recall.")
    ] = "vsd,mssd,mspd",
    true_z: Annotated[
        bool, typer.Option("--true-z", help="Move every pose along its ray to the true z first, as the paper does.")
    ] = False,
    symmetries: Annotated[
        Literal["models_info", "table"],
        typer.Option(help="Whose symmetries count: models_info.json's, as in BOP, or the dataset's own table's."),
    ] = "models_info",
    depth: Annotated[
        Literal["image", "models"],
        typer.Option(help="VSD's scene: the depth images, or the models in their true poses."),
    ] = "image",
    models: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the models, if they are not in the dataset.")
    ] = None,
    to: Annotated[Path | None, typer.Option(metavar="FILE", help="HTML page to write.")] = None,
    split: Split = None,
    workers: Workers = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the score as JSON.")] = False,
) -> None:
    """Score the estimated poses of any method.

    Recalls by BOP's errors and by the paper's rule, for each object, by margin, elevation and visibility.
    """
    from synthetless.learning.score import Judge, score
    from synthetless.learning.score_report import to_text, write_score_page

    judge = Judge(dataset, split, models, tuple(_words(errors)), true_z, symmetries, depth)  # type: ignore[arg-type]  # it checks
    found = score(judge, results, workers)
    if to is not None:
        write_score_page(found, to)
    print(json.dumps(found.to_json()) if as_json else to_text(found))
    if to is not None and not as_json:
        print(f"page: {to}")


def compare_command(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the page.")],
    models: Annotated[str, typer.Option(metavar="DIR", help="BOP models folder, or builtin.")] = "builtin",
    objects: Annotated[str, typer.Option(metavar="LIST", help="Object ids.")] = "18,27,29,30",
    labels: Annotated[
        str, typer.Option(metavar="LIST", help="Some of true, map, pitteri2019, pitteri2019-top, atlas.")
    ] = "true,map,pitteri2019,pitteri2019-top,atlas",
    seeds: Annotated[int, typer.Option(min=1, metavar="N", help="Runs of each label set.")] = 3,
    steps: Annotated[int, typer.Option(min=1, metavar="N", help="Batches of a run.")] = 1500,
    poses: Annotated[
        Literal["upright", "any"], typer.Option(help="upright: parts that stand on a table; any: every rotation.")
    ] = "upright",
    workers: Workers = None,
) -> None:
    """Prove what the labels are worth.

    Trains the same small network on ray-cast crops under several label sets.
    """
    need_torch()
    from synthetless.generation.sources import BUILTIN_MODELS
    from synthetless.learning.compare import COLUMNS, Comparison, compare, table_rows
    from synthetless.learning.stream import CropSettings

    comparison = Comparison(
        BUILTIN_MODELS if models == BUILTIN else Path(models),
        tuple(_numbers("--objects", objects)),
        tuple(_words(labels)),  # type: ignore[arg-type]  # it checks
        seeds,
        steps,
        crops=CropSettings(poses=poses),
    )
    runs = compare(comparison, out, workers)
    rows = [COLUMNS, *table_rows(runs, comparison.labels)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(COLUMNS))]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    print(f"page: {out / 'index.html'}")


def need_torch() -> None:
    """Refuse in one line where the extra is not installed.

    Raises:
        UserError: torch cannot be imported.
    """
    try:
        import torch  # noqa: F401
    except ImportError as error:
        raise UserError(f"this command needs torch ({error}): pip install 'synthetless[learn]'") from None


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _numbers(option: str, text: str) -> list[int]:
    try:
        return [int(word) for word in _words(text)]
    except ValueError:
        raise UserError(f"{option} is {text!r}; object ids such as 18,27 are needed") from None
