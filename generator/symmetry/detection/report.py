"""Symmetries as text for a person to read: what was detected on a folder, and what a symmetry table means.

Of a table: groups, regressors, margins, and the views in which labels are about to jump.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from synthetless.symmetry.atlas import SCHEMES, Scheme, smallest_margin_deg
from synthetless.symmetry.detection.detect import Detected
from synthetless.symmetry.detection.folder import DetectedFolder, DetectedObject
from synthetless.symmetry.detection.residual import GroupFit
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.point_groups import parse_name
from synthetless.symmetry.quaternions import Floats, rotate, to_matrix
from synthetless.symmetry.table import SymmetryEntry, SymmetryTable

DANGEROUS_DEG = 5.0
"""A margin below this is called dangerous: a pose estimator's error is of that size."""

_POSES = 20_000  # of the search for dangerous views
_DIRECTIONS: Mapping[tuple[int, int, int], str] = {
    (1, 0, 0): "to the right in the image",
    (-1, 0, 0): "to the left in the image",
    (0, 1, 0): "down in the image",
    (0, -1, 0): "up in the image",
    (0, 0, 1): "away from the camera",
    (0, 0, -1): "towards the camera",
}

_NONE = "-"
_WIDTH = 100
_RESIDUAL_HEAD = ["max mm", "%", "p95 mm", "%", "rms mm", "%"]


def report(detected: DetectedFolder) -> str:
    """Every object's residual table, then one line for each, then what to look at twice."""
    blocks = [residual_table(o) for o in detected.objects]
    return "\n\n".join([*blocks, summary(detected), *_quasi_summary(detected), *_remarks(detected)])


def residual_table(o: DetectedObject) -> str:
    """The groups that are the answer at some tolerance, and the declared one; the answer is marked."""
    found = o.detected
    shown = [*found.staircase]
    if found.declared is not None and found.declared not in shown:
        shown = [*shown, found.declared]
    rows = [["", "group", "axis", "fixed point mm", *_RESIDUAL_HEAD, ""]]
    for fit in shown:
        marker = ">" if fit == found.answer else ""
        note = "declared" if fit == found.declared else ""
        rows.append([marker, *group_cells(fit.group), *_residual_cells(fit, found), note])
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
        *(f"object {obj_id}: within {tolerance}" for obj_id, tolerance in sorted(detected.tolerances.items())),
    ]
    return "\n".join([text, "", *legend])


def _quasi_summary(detected: DetectedFolder) -> list[str]:
    """One line for each object, if larger groups were asked for that they have but for a detail."""
    lines = []
    for o in detected.objects:
        if o.quasi is not None:
            name, axis, offset = group_cells(o.quasi.group)
            place = f"axis {axis}, fixed point {offset}"
            lines.append(f"  object {o.obj_id}: {name}, {place}, but for {o.quasi.residual.max_mm:.3f} mm")
        elif o.quasi_tolerance_mm is not None:
            lines.append(f"  object {o.obj_id}: no larger group within {o.quasi_tolerance_mm:.3f} mm")
    return ["\n".join(["quasi-symmetries:", *lines])] if lines else []


def group_cells(group: SymmetryGroup) -> list[str]:
    """Name, axis and fixed point, as short as they can be said."""
    axis = _NONE if group.axis is None else axis_text(group.axis)
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
        return _NONE
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


def _residual_cells(fit: GroupFit, found: Detected) -> list[str]:
    residual = fit.residual
    cells = []
    for value in (residual.max_mm, residual.p95_mm, residual.rms_mm):
        cells += [f"{value:.3f}", f"{100 * value / found.diameter_mm:.2f}"]
    return cells


def _cost(fit: GroupFit | None, found: Detected) -> str:
    if fit is None:
        return _NONE
    return f"{fit.group.name} {100 * fit.residual.max_mm / found.diameter_mm:.2f} %"


def _short(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".rstrip("0").rstrip(".") if round(value, digits) else "0"


def _remarks(detected: DetectedFolder) -> list[str]:
    lines = [f"warning: object {o.obj_id} ({o.path.name}) {o.warning}" for o in detected.objects if o.warning]
    if detected.unit_warning:
        lines.append(f"warning: {detected.unit_warning}")
    if detected.are_numbered:
        numbers = ", ".join(f"{o.obj_id} = {o.path.name}" for o in detected.objects)
        lines.append(f"not every file's name is an object id, so they are numbered in alphabetical order: {numbers}")
    return ["\n".join(textwrap.fill(line, _WIDTH, subsequent_indent="  ") for line in lines)] if lines else []


def describe(table: SymmetryTable) -> str:
    """The table as text: a line per object, then per kind of symmetry which views are dangerous."""
    head = ["object", "group", "order", "axis", "fixed point mm"]
    rows = [head + [text for scheme in SCHEMES for text in (scheme, "margin")]]
    for obj_id, entry in table.entries.items():
        name, axis, offset = group_cells(entry.group)
        order = f"{entry.group.order:.0f}" if entry.group.is_finite else "infinite"
        margins = [text for scheme in SCHEMES for text in _scheme_cells(entry, scheme)]
        rows.append([str(obj_id), name, order, axis, offset, *margins])
    about = "the ray to the object" if table.allocentric else "the camera"
    notes = [
        f"scheme of this table: {table.scheme}; rotations relative to {about}",
        "pitteri2019, atlas: numbers of regressors",
        "margin: by how many degrees any pose may turn before its label jumps; 0 if there are poses on a jump",
        f"dangerous under pitteri2019 (margin below {DANGEROUS_DEG:g} degrees):",
    ]
    return "\n".join([aligned(rows, left=(1, 3, 4)), "", *notes, *_dangers(table), *_quasi_lines(table)])


def described(table: SymmetryTable) -> dict[str, Any]:
    """What ``describe`` tells, as JSON values: the table, and for each object and scheme its regressors and margin."""
    objects = {
        str(obj_id): {
            "n_regressors": {scheme: entry.canonical_map(scheme).n_regressors for scheme in SCHEMES},
            "smallest_margin_deg": {s: smallest_margin_deg(parse_name(entry.group.name), s) for s in SCHEMES},
            "dangerous_views": dangerous_views(entry),
        }
        for obj_id, entry in table.entries.items()
    }
    return {"table": table.to_dict(), "objects": objects}


def dangerous_views(entry: SymmetryEntry) -> str:
    """In words: in which views labels made by `pitteri2019` are about to jump.

    Directions are the camera's: x right, y down, z forward.
    """
    group = entry.group
    reference = np.eye(3) if entry.reference_rotation is None else np.array(entry.reference_rotation)
    name = parse_name(group.name)
    if group.axis is None or name.family == "T":
        return "none"
    start = reference @ np.array(group.axis)
    axis = _axis_name(group)
    match name.family:
        case "C":
            return f"where {axis} points {direction_text(-start)}{_end_seen(group, -start)}; {_within(name.n)}"
        case "SO(2)":
            place = f"where {axis} points {direction_text(-start)}{_end_seen(group, -start)}"
            return f"{place}; within {DANGEROUS_DEG:g} degrees of that, and near it labels turn faster than the part"
        case "O(2)":
            anchors = entry.canonical_map("pitteri2019").anchors_wxyz
            first, second = (rotate(anchor, np.array(group.axis)) for anchor in anchors)
            across = np.cross(first, second)
            return f"where {axis} points {direction_text(across)} or opposite; within {DANGEROUS_DEG:g} degrees of that"
    return _by_sampling(entry, start, axis)


def direction_text(direction: Floats) -> str:
    """A direction of the camera frame in words."""
    for unit, text in _DIRECTIONS.items():
        if float(np.dot(unit, direction)) > np.cos(np.radians(1)):
            return text
    x, y, z = direction
    return f"along ({x:.2f} {y:.2f} {z:.2f}) (x right, y down, z forward)"


def _scheme_cells(entry: SymmetryEntry, scheme: Scheme) -> list[str]:
    margin = smallest_margin_deg(parse_name(entry.group.name), scheme)
    return [str(entry.canonical_map(scheme).n_regressors), "no jump" if margin >= 180 else f"{margin:.2f}"]


def _quasi_lines(table: SymmetryTable) -> list[str]:
    """One line for each object with a larger group that it nearly has; none if there are no such objects."""
    lines = []
    for obj_id, entry in table.entries.items():
        if entry.quasi is not None:
            name, axis, offset = group_cells(entry.quasi.group)
            tolerance = entry.quasi.tolerance_mm
            within = "" if tolerance is None else f", but for a detail of at most {tolerance:g} mm"
            lines.append(f"  object {obj_id}: {name}, axis {axis}, fixed point {offset}{within}")
    return (
        ["quasi-symmetries (whether an image can tell them from symmetries: synthetless ambiguity):", *lines]
        if lines
        else []
    )


def _dangers(table: SymmetryTable) -> list[str]:
    """One line for each kind of entry, with its objects."""
    objects: dict[str, list[int]] = {}
    for obj_id, entry in table.entries.items():
        axis = "" if entry.group.axis is None else f" about {group_cells(entry.group)[1]}"
        objects.setdefault(f"{entry.group.name}{axis}: {dangerous_views(entry)}", []).append(obj_id)
    lines = [f"{_ids(ids)}, {text}" for text, ids in objects.items()]
    return [textwrap.fill(line, _WIDTH, initial_indent="  ", subsequent_indent="      ") for line in lines]


def _ids(ids: list[int]) -> str:
    """`object 3` or `objects 1-4, 13`."""
    ranges: list[list[int]] = []
    for obj_id in ids:
        if ranges and obj_id == ranges[-1][-1] + 1:
            ranges[-1].append(obj_id)
        else:
            ranges.append([obj_id])
    texts = [f"{r[0]}-{r[-1]}" if len(r) > 1 else str(r[0]) for r in ranges]
    return f"object{'s' if len(ids) > 1 else ''} {', '.join(texts)}"


def _axis_name(group: SymmetryGroup) -> str:
    assert group.axis is not None
    text = axis_text(group.axis)
    return f"+{text}" if len(text) == 1 else f"the axis {text}"


def _end_seen(group: SymmetryGroup, direction: Floats) -> str:
    towards_camera = direction[2] < -np.cos(np.radians(1))
    return (
        f", the part seen straight onto its {_axis_name(group).removeprefix('the axis ')} end" if towards_camera else ""
    )


def _within(n: int) -> str:
    """How near to that view a C_n's margin is below the limit: it is 2 asin(cos(tilt / 2) sin(pi / 4n)) at least."""
    cosine = np.sin(np.radians(DANGEROUS_DEG / 2)) / np.sin(np.pi / (4 * n))
    if cosine >= 1:
        return "at some turns about the axis in every other view too"
    return f"within {180 - np.degrees(2 * np.arccos(cosine)):.0f} degrees of that at some turns about the axis"


def _by_sampling(entry: SymmetryEntry, start: Floats, axis: str) -> str:
    """The share of dangerous poses, and where the main axis points in them."""
    R = to_matrix(SymmetryGroup("SO(3)").sampled_wxyz(_POSES))
    labels = entry.canonical_map("pitteri2019")(R, np.tile([0.0, 0.0, 1e3], (_POSES, 1)))
    dangerous = labels.discontinuity_margin_deg < DANGEROUS_DEG
    share = f"{100 * dangerous.mean():.1f} % of all orientations"
    if entry.group.family != "D" or not dangerous.any():
        return f"{share}, scattered over all views"
    tilt = np.degrees(np.arccos(np.clip(R[dangerous] @ np.array(entry.group.axis) @ start, -1, 1)))
    low, high = np.floor(tilt.min()), np.ceil(tilt.max())
    return f"{share}, all with {axis} {low:.0f} to {high:.0f} degrees from pointing {direction_text(start)}"
