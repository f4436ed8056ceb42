"""What was detected, as text for a person to read."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence

import numpy as np

from synthetless.symmetry.detection.detect import Detected, Finding
from synthetless.symmetry.detection.folder import DetectedFolder, DetectedObject
from synthetless.symmetry.groups import SymmetryGroup

NONE = "-"
WIDTH = 100


def report(detected: DetectedFolder) -> str:
    """Every object's residual table, then one line for each, then what to look at twice."""
    blocks = [residual_table(o) for o in detected.objects]
    return "\n\n".join([*blocks, summary(detected), *_remarks(detected)])


def residual_table(o: DetectedObject) -> str:
    """The groups that are the answer at some tolerance, and the declared one; the answer is marked."""
    found = o.detected
    shown = [*found.staircase]
    if found.declared is not None and found.declared not in shown:
        shown = [*shown, found.declared]
    rows = [["", "group", "axis", "fixed point mm", *_RESIDUAL_HEAD, ""]]
    for finding in shown:
        marker = ">" if finding == found.answer else ""
        note = "declared" if finding == found.declared else ""
        rows.append([marker, *group_cells(finding.group), *_residual_cells(finding, found), note])
    head = f"object {o.obj_id}  {o.path.name}  diameter {found.diameter_mm:.4g} mm"
    return f"{head}\n{aligned(rows, left=(0, 1, 2, 3, 10))}"


def summary(detected: DetectedFolder) -> str:
    """One line per object: its group, how well it fits, and what the next larger one would cost."""
    has_declared = any(o.detected.declared for o in detected.objects)
    head = ["object", "group", "axis", "fixed point mm", *_RESIDUAL_HEAD, "next larger"]
    rows = [head + ["declared"] * has_declared]
    for o in detected.objects:
        found = o.detected
        row = [str(o.obj_id), *group_cells(found.answer.group), *_residual_cells(found.answer, found)]
        row.append(_cost(found.next_larger, found))
        rows.append(row + [_cost(found.declared, found)] * has_declared)
    text = aligned(rows, left=(1, 2, 3, 10, 11))
    legend = [
        "residuals over all elements of the group: largest, 95th percentile, root mean square; % of the diameter",
        f"group: the largest one within {detected.tolerance_percent:g} %",
    ]
    return "\n".join([text, "", *legend])


def group_cells(group: SymmetryGroup) -> list[str]:
    """Name, axis and fixed point, as short as they can be said."""
    axis = NONE if group.axis is None else axis_text(group.axis)
    if group.secondary_axis is not None:
        axis += f", {axis_text(group.secondary_axis)}"
    return [group.name, axis, offset_text(group)]


def axis_text(axis: Sequence[float]) -> str:
    """`x`, `-y` where three digits cannot tell the axis from it, or the components."""
    for sign, mark in ((1, ""), (-1, "-")):
        for unit, name in zip(np.eye(3), "xyz", strict=True):
            if np.allclose(sign * unit, axis, atol=5e-4):
                return mark + name
    return "(" + " ".join(_short(value, 3) for value in axis) + ")"


def offset_text(group: SymmetryGroup) -> str:
    """The fixed point, `origin` if it is that."""
    if group.name == "C1":
        return NONE
    return "(" + " ".join(_short(value, 2) for value in group.offset_mm) + ")" if any(group.offset_mm) else "origin"


def aligned(rows: Sequence[Sequence[str]], left: Iterable[int] = ()) -> str:
    """Rows of cells as columns, numbers to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    left = set(left)
    lines = []
    for row in rows:
        cells = [
            cell.ljust(w) if i in left else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


_RESIDUAL_HEAD = ["max mm", "%", "p95 mm", "%", "rms mm", "%"]


def _residual_cells(finding: Finding, found: Detected) -> list[str]:
    residual = finding.residual
    cells = []
    for value in (residual.max_mm, residual.p95_mm, residual.rms_mm):
        cells += [f"{value:.3f}", f"{100 * value / found.diameter_mm:.2f}"]
    return cells


def _cost(finding: Finding | None, found: Detected) -> str:
    if finding is None:
        return NONE
    return f"{finding.group.name} {100 * finding.residual.max_mm / found.diameter_mm:.2f} %"


def _short(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".rstrip("0").rstrip(".") if round(value, digits) else "0"


def _remarks(detected: DetectedFolder) -> list[str]:
    lines = [f"warning: object {o.obj_id} ({o.path.name}) {o.warning}" for o in detected.objects if o.warning]
    if detected.are_numbered:
        numbers = ", ".join(f"{o.obj_id} = {o.path.name}" for o in detected.objects)
        lines.append(f"not every file's name is an object id, so they are numbered in alphabetical order: {numbers}")
    return ["\n".join(textwrap.fill(line, WIDTH, subsequent_indent="  ") for line in lines)] if lines else []
