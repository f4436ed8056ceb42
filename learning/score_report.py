"""A score as a table for the terminal and as a page for the browser."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import groupby
from pathlib import Path

from synthetless.learning.pages import Section, line_chart, write_page
from synthetless.learning.score import PAPER_TAU_MM, PAPER_THRESHOLD, Row, Score

_NAMES = {"vsd": "AR VSD", "mssd": "AR MSSD", "mspd": "AR MSPD", "paper": "VSD < 0.3"}


def to_text(score: Score) -> str:
    """The table for the terminal."""
    head = ("", "instances", *_heads(score))
    table = [head, ("all", str(len(score.targets)), *_cells(score, score.average_recalls))]
    for group, rows in groupby(score.rows(), key=lambda row: row.group):
        table += [("",) * len(head), *(_row(score, f"{group} {row.name}", row) for row in rows)]
    widths = [max(len(line[i]) for line in table) for i in range(len(head))]
    lines = [
        "  ".join(
            cell.rjust(width) if i else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in table
    ]
    return "\n".join([*(line.rstrip() for line in lines), "", " ".join(_notes(score))])


def write_score_page(score: Score, path: Path) -> None:
    """The same as a page, with the recalls as curves over their thresholds.

    Raises:
        UserError: jinja2 or matplotlib is not installed, or the file cannot be written.
    """
    columns = ("", "instances", *_heads(score))
    sections = [
        Section(
            text=" ".join(_notes(score)),
            columns=columns,
            rows=[("all", str(len(score.targets)), *_cells(score, score.average_recalls))],
        )
    ]
    for group, rows in groupby(score.rows(), key=lambda row: row.group):
        sections.append(Section(f"By {group}", "", columns, [_row(score, row.name, row) for row in rows]))
    axes = {"vsd": "threshold of VSD", "mssd": "threshold of MSSD / diameter", "mspd": "threshold of MSPD, pixels"}
    for error in score.judge.errors:
        thresholds, recall = score.recall_curve(error)
        svg = line_chart({"recall": (thresholds.tolist(), recall.tolist())}, axes[error], "recall")
        sections.append(Section(f"Recall by {error.upper()}", svg=svg))
    write_page(path, f"Score on {score.judge.dataset.name}", sections)


def _heads(score: Score) -> Iterator[str]:
    yield from (_NAMES[name] for name in score.measured)
    yield "AR"


def _cells(score: Score, recalls: Mapping[str, float]) -> Iterator[str]:
    yield from (f"{recalls[name]:.1%}" for name in score.measured)
    yield f"{sum(recalls[error] for error in score.judge.errors) / len(score.judge.errors):.1%}"


def _row(score: Score, name: str, row: Row) -> tuple[str, ...]:
    return name, str(row.targets), *_cells(score, row.recalls)


def _notes(score: Score) -> Iterator[str]:
    yield f"{score.estimates} estimated poses."
    if score.judge.true_z:
        yield "Estimates were moved to the true z."
    if "vsd" in score.judge.errors:
        yield (
            f"{_NAMES['paper']}: tolerance {PAPER_TAU_MM:g} mm, error below {PAPER_THRESHOLD:g}; over all objects, the "
            "mean of theirs."
        )
        if score.judge.depth == "models":
            yield "VSD against the depth of the true poses' models, not against the depth images."
    if score.judge.symmetries == "table":
        yield "Symmetries of the dataset's table, not those of models_info.json."
