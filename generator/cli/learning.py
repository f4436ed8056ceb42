"""Commands of the learning system: train, predict, score, compare."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from synthetless.cli.options import AsJson, RecipeArgument, Split, Workers, above_zero
from synthetless.cli.terminal import say
from synthetless.extras import need


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
    say(json.dumps(found.to_json()) if as_json else to_text(found))
    if to is not None and not as_json:
        say(f"page: {to}")


def compare_command(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the page.")],
    models: Annotated[str, typer.Option(metavar="DIR", help="BOP models folder, or builtin.")] = "builtin",
    objects: Annotated[str, typer.Option(metavar="LIST", help="Object ids.")] = "18,27,29,30",
    labels: Annotated[
        str, typer.Option(metavar="LIST", help="Some of true, map, pitteri2019, pitteri2019-top, atlas.")
    ] = "true,map,pitteri2019,pitteri2019-top,atlas",
    seeds: Annotated[int, typer.Option(min=1, metavar="N", help="Runs of each label set.")] = 3,
    steps: Annotated[int, typer.Option(min=1, metavar="N", help="Batches of a run.")] = 1500,
    crops: Annotated[
        int, typer.Option(min=10, metavar="N", help="Crops to learn from; a tenth as many are held out.")
    ] = 12_000,
    poses: Annotated[
        Literal["upright", "any"], typer.Option(help="upright: parts that stand on a table; any: every rotation.")
    ] = "upright",
    margin_weight: Annotated[
        float | None,
        typer.Option(
            callback=above_zero,
            metavar="DEGREES",
            help="Weight the loss by the margin, which counts in full from here on.",
        ),
    ] = None,
    rendered: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Dataset of the same parts to measure the networks on, too.")
    ] = None,
    tune: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Another one, to learn from afterwards and to be measured again."),
    ] = None,
    width: Annotated[int, typer.Option(min=1, metavar="N", help="Channels of the network's first layer.")] = 16,
    workers: Workers = None,
    as_json: AsJson = False,
) -> None:
    """Prove what the labels are worth.

    Trains the same small network on ray-cast crops under several label sets.
    """
    need("torch")
    from synthetless.config import models_folder
    from synthetless.learning.compare import COLUMNS, Comparison, compare, table_rows
    from synthetless.learning.stream import CropSettings

    comparison = Comparison(
        models_folder(models),
        tuple(_numbers("--objects", objects)),
        tuple(_words(labels)),  # type: ignore[arg-type]  # it checks
        seeds,
        steps,
        train_crops=crops,
        validation_crops=crops // 10,
        crops=CropSettings(poses=poses),
        rendered=rendered,
        full_weight_deg=margin_weight,
        width=width,
        tuning=tune,
    )
    runs = compare(comparison, out, workers)
    tables = {"crops": table_rows(runs, comparison.labels)}
    for name, dataset in (("rendered", rendered), ("tuned", tune)):
        tables[name] = [] if dataset is None else table_rows(runs, comparison.labels, f"{name}, all")
    if as_json:
        named = {name: [dict(zip(COLUMNS, row, strict=True)) for row in table] for name, table in tables.items()}
        say(json.dumps({"page": str(out / "index.html"), **named}))
        return
    rows = [COLUMNS, *tables.pop("crops")]
    for name, table in tables.items():
        if table:
            rows += [(f"{name}:", *[""] * (len(COLUMNS) - 1)), *table]
    widths = [max(len(row[i]) for row in rows) for i in range(len(COLUMNS))]
    for row in rows:
        say("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    say(f"page: {out / 'index.html'}")


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _numbers(option: str, text: str) -> list[int]:
    from synthetless.errors import UserError

    try:
        return [int(word) for word in _words(text)]
    except ValueError:
        raise UserError(f"{option} is {text!r}; object ids such as 18,27 are needed") from None


def train_command(
    config: RecipeArgument,
    data: Annotated[list[Path], typer.Option(metavar="DIR", help="Folder of a dataset; may be given several times.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the run. Give it again to continue it.")],
    labels: Annotated[
        str | None, typer.Option(metavar="SET", help="true, map, pitteri2019, pitteri2019-top or atlas.")
    ] = None,
    device: Annotated[str, typer.Option(metavar="NAME", help="auto, cpu, cuda, cuda:1, ...")] = "auto",
    models: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the models, if they are not in the dataset.")
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a setting; may be given several times."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Train the detector and its pose head.

    Several GPUs: torchrun --nproc-per-node N -m synthetless train CONFIG ...
    """
    need("torch")
    from synthetless.config import load_settings
    from synthetless.learning.settings import Training

    given = [*(overrides or []), *([f'labels="{labels}"'] if labels is not None else [])]
    training = load_settings(Training, config, given)
    from synthetless.learning.fit import NO_LOSSES
    from synthetless.learning.train import PAGE_FILE, train  # after the settings: a wrong one is told at once

    steps = training.schedule.steps

    def tell(record: dict[str, Any]) -> None:
        if as_json:
            print(json.dumps(record), file=sys.stderr, flush=True)
            return
        shown = ", ".join(f"{name} {value:.3f}" for name, value in record.items() if name not in NO_LOSSES)
        left = record["seconds_left"]
        say(f"step {record['step']} of {steps}: {shown}; {left / 60:.0f} min left")

    train(training, data, out, device, models, tell)
    answer = {"run": str(out), "curves": str(out / PAGE_FILE)}
    say(json.dumps(answer) if as_json else f"run: {out}\ncurves: {out / PAGE_FILE}")


def predict_command(
    run: Annotated[Path, typer.Argument(help="Folder of a training.")],
    dataset: Annotated[Path, typer.Argument(help="Folder of a BOP dataset, whose pictures and cameras are used.")],
    to: Annotated[Path, typer.Option(metavar="FILE", help="BOP result file to write.")],
    overlays: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for pictures with true and predicted boxes.")
    ] = None,
    split: Split = None,
    camera: Annotated[
        Path | None, typer.Option(metavar="FILE", help="BOP's camera.json, if DATASET is a plain folder of pictures.")
    ] = None,
    device: Annotated[str, typer.Option(metavar="NAME", help="auto, cpu, cuda, ...")] = "auto",
    as_json: AsJson = False,
) -> None:
    """Predict poses with a trained detector.

    The classifier chooses the regressor, its corners are solved for the pose. Judge the file with score.
    """
    need("torch")
    from synthetless.learning.predict import predict

    found = predict(run, dataset, to, overlays, split, device, camera)
    if as_json:
        say(json.dumps({"poses": found.poses, "file": str(to), "box_map": found.box_map}))
        return
    say(f"{found.poses} poses in {to}")
    if found.box_map is not None:
        say(f"boxes: mAP {found.box_map:.3f} at an overlap of 0.5")


def curves_command(
    runs: Annotated[list[Path], typer.Argument(help="Folders of trainings.")],
    to: Annotated[Path, typer.Option(metavar="FILE", help="HTML page to write.")],
    as_json: AsJson = False,
) -> None:
    """Draw the learning curves of several trainings.

    In one figure for each loss.
    """
    need("torch")
    from synthetless.learning.train import write_curves

    write_curves(runs, to)
    say(json.dumps({"page": str(to)}) if as_json else f"page: {to}")
