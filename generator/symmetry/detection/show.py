"""What a symmetry table means, in words: groups, regressors, margins, and the views that are dangerous."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from synthetless.errors import UserError
from synthetless.io.files import read_json
from synthetless.io.models import INFO_FILE
from synthetless.symmetry.atlas import SCHEMES, Scheme, smallest_margin_deg
from synthetless.symmetry.detection.report import WIDTH, aligned, axis_text, group_cells
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.point_groups import parse_name
from synthetless.symmetry.quaternions import Floats, rotate, to_matrix
from synthetless.symmetry.table import SymmetryEntry, SymmetryTable

DANGEROUS_DEG = 5.0
"""A margin below this is called dangerous: a pose estimator's error is of that size."""

_TABLE_FILE = "symmetries.json"
_POSES = 20_000
_DIRECTIONS: Mapping[tuple[int, int, int], str] = {
    (1, 0, 0): "to the right in the image",
    (-1, 0, 0): "to the left in the image",
    (0, 1, 0): "down in the image",
    (0, -1, 0): "up in the image",
    (0, 0, 1): "away from the camera",
    (0, 0, -1): "towards the camera",
}


def read_table(path: Path) -> SymmetryTable:
    """The table in a file, or in a folder's `symmetries.json` or `models_info.json`.

    Raises:
        UserError: there is none, or it is wrong; with the file's name.
    """
    if path.is_dir():
        found = [path / name for name in (_TABLE_FILE, INFO_FILE) if (path / name).exists()]
        if not found:
            raise UserError(f"{path}: holds neither {_TABLE_FILE} nor {INFO_FILE}; symmetries detect can write one")
        path = found[0]
    if path.name != INFO_FILE:
        return SymmetryTable.read(path)
    content = read_json(path)
    try:
        return SymmetryTable.from_models_info(content)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error


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
    return "\n".join([aligned(rows, left=(1, 3, 4)), "", *notes, *_dangers(table)])


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


def _dangers(table: SymmetryTable) -> list[str]:
    """One line for each kind of entry, with its objects."""
    objects: dict[str, list[int]] = {}
    for obj_id, entry in table.entries.items():
        axis = "" if entry.group.axis is None else f" about {group_cells(entry.group)[1]}"
        objects.setdefault(f"{entry.group.name}{axis}: {dangerous_views(entry)}", []).append(obj_id)
    lines = [f"{_ids(ids)}, {text}" for text, ids in objects.items()]
    return [textwrap.fill(line, WIDTH, initial_indent="  ", subsequent_indent="      ") for line in lines]


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
