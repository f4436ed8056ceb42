"""Result files of the BOP challenge: one CSV row for each estimated pose.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_challenge_2019.md
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.io.files import atomic_write, read_bytes
from synthetless.symmetry.quaternions import from_matrix

HEADER = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
NO_TIME = -1.0
_TIME_TOLERANCE_S = 1e-3
Number = TypeVar("Number", int, float)


@dataclass(frozen=True, eq=False)
class Estimate:
    """An estimated pose.

    Attributes:
        scene_id, im_id: the image.
        obj_id: BOP object id.
        score: confidence; of several poses of an object in an image the highest are judged first.
        R_m2c: (3, 3) rotation, model to camera, as it stands in the file.
        t_m2c: (3,) translation, millimetres.
        time_s: seconds for the whole image, or ``NO_TIME``.
        row: number of the line in the file, from 1; 0 if it is from no file.
    """

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    R_m2c: NDArray[np.float64]
    t_m2c: NDArray[np.float64]
    time_s: float = NO_TIME
    row: int = 0


def read_results(path: Path) -> list[Estimate]:
    """The poses of a result file, in its order; the header may be missing, as bop_toolkit has it.

    Raises:
        UserError: the file is missing, empty or damaged; with the row and what is wrong in it.
    """
    try:
        text = read_bytes(path).decode("utf-8")
    except UnicodeDecodeError:
        raise UserError(f"{path}: is no text; a CSV file with the columns {','.join(HEADER)} is needed") from None
    rows = list(csv.reader(io.StringIO(text)))
    if not rows:
        raise UserError(f"{path}: is empty; its first line must be {','.join(HEADER)}")
    first = 1 if tuple(field.strip() for field in rows[0]) == HEADER else 0
    estimates = [_estimate(path, number, row) for number, row in enumerate(rows, start=1) if number > first and row]
    _check_times(path, estimates)
    return estimates


def write_results(path: Path, estimates: Iterable[Estimate]) -> None:
    """Write a result file, whole or not at all; 17 digits give the same float64 back."""
    lines = [",".join(HEADER), *(_line(estimate) for estimate in estimates)]
    atomic_write(path, ("\n".join(lines) + "\n").encode())


def _line(of: Estimate) -> str:
    R, t = (" ".join(f"{number:.17g}" for number in np.ravel(values)) for values in (of.R_m2c, of.t_m2c))
    return f"{of.scene_id},{of.im_id},{of.obj_id},{of.score:.17g},{R},{t},{of.time_s:.6g}"


def _estimate(path: Path, number: int, row: list[str]) -> Estimate:
    place = f"{path}, row {number}"
    if len(row) != len(HEADER):
        raise UserError(f"{place}: has {len(row)} fields, not the {len(HEADER)} of {','.join(HEADER)}")
    scene_id, im_id, obj_id = (
        _number(place, name, field, int) for name, field in zip(HEADER[:3], row[:3], strict=True)
    )
    R = _numbers(place, "R", row[4], 9).reshape(3, 3)
    from_matrix(R[None], name=lambda _: f"{place}: R")
    return Estimate(
        scene_id,
        im_id,
        obj_id,
        _number(place, "score", row[3], float),
        R,
        _numbers(place, "t", row[5], 3),
        _number(place, "time", row[6], float),
        number,
    )


def _number(place: str, name: str, text: str, kind: Callable[[str], Number]) -> Number:
    try:
        if math.isfinite(value := kind(text)):
            return value
    except ValueError:
        pass
    needed = "a whole number" if kind is int else "a finite number"
    raise UserError(f"{place}: {name} is {text.strip()[:40]!r}, not {needed}")


def _numbers(place: str, name: str, text: str, count: int) -> NDArray[np.float64]:
    fields = text.split()
    if len(fields) != count:
        raise UserError(f"{place}: {name} has {len(fields)} numbers, not {count}")
    return np.array([_number(place, name, field, float) for field in fields], dtype=np.float64)


def _check_times(path: Path, estimates: Iterable[Estimate]) -> None:
    """The time is that of the image: all its rows must agree, or bop_toolkit refuses the file."""
    times: dict[tuple[int, int], Estimate] = {}
    for estimate in estimates:
        if estimate.time_s < 0:
            continue
        first = times.setdefault((estimate.scene_id, estimate.im_id), estimate)
        if abs(first.time_s - estimate.time_s) > _TIME_TOLERANCE_S:
            raise UserError(
                f"{path}, row {estimate.row}: time is {estimate.time_s:g}, but {first.time_s:g} in row {first.row} of "
                f"the same image; it is the time of the whole image"
            )
