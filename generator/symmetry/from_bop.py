"""From the symmetry fields of BOP's `models_info.json` to an exact group.

`symmetries_discrete` are 4x4 matrices (16 numbers, row-major, or nested) without the identity, not necessarily closed
and sometimes noisy; `symmetries_continuous` are {axis, offset}.

A list of noisy rotations is judged as a whole: every finite group is placed so that the rotations are as near to its
elements as can be, and the smallest group that all of them fit is the one that they generate. How far they may be off
depends on how far apart the elements of similar groups are (see `tolerance_deg`).
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.io.documents import shown
from synthetless.symmetry.point_groups import (
    MAX_ORDER,
    Family,
    GroupName,
    Z,
    frame_of_axis,
    standard_elements,
)
from synthetless.symmetry.quaternions import (
    IDENTITY,
    Floats,
    angle_deg,
    conjugate,
    cross,
    from_axis_angle,
    from_matrix,
    multiply,
    normalise,
    rotate,
    to_matrix,
)

NOISE_DEG = 0.5  # of a file's rotations; one by less than this is the identity
_TURN_DEG = 0.52  # a turn about a common axis: the noise, and what the tilt of its own axis adds
SILENT_DEG = 0.1  # a group that is farther off than this is worth a warning
FIT_DEG = 1.0  # axes nearer than this are one
MANY_TURNS = 72  # a C_n of at least this order is probably a solid of revolution, sampled

_CYCLIC_DEG = {6: 2.0, 12: 0.75}  # how far off a C_n up to an order may be
_OTHER_DEG = {6: 1.0}  # likewise a D_n, T, O or I
_FIELDS = ("symmetries_discrete", "symmetries_continuous")
_MOST_LISTED = 1000  # rotations, repeated ones included
_POLYHEDRAL = (GroupName("T", 0), GroupName("O", 0), GroupName("I", 0))
_ACROSS = float(np.cos(np.radians(45)))
_NEW_AXIS = float(np.cos(np.radians(5)))
_MATCHED_DEG = 3.0  # angles of rotations and between axes that may be the same, when a frame is first sought
_TRIED = 20  # rotations that first frames are judged by
_WRITE_A_TABLE = "write the group into a symmetry table instead, for example {group: C4, axis: [0, 0, 1]}"
_AMONG_EQUALS = normalise([1.0, 3.1e-3, 4.7e-3, 2.3e-3])  # chooses between frames that are equally near the identity


class Recognised(NamedTuple):
    """A group: its name, its frame (rotation from the standard frame, wxyz) and a point every element fixes, mm.

    `remarks` are what a person should know about the file, one line each.
    """

    name: GroupName
    frame_wxyz: Floats
    offset_mm: Floats
    remarks: tuple[str, ...] = ()


class Motion(NamedTuple):
    """A rigid motion of the model that is said to leave it unchanged."""

    rotation_wxyz: Floats
    translation_mm: Floats


class Line(NamedTuple):
    """A continuous symmetry's axis: unit direction and a point on it, mm."""

    axis: Floats
    point_mm: Floats


class Placement(NamedTuple):
    """A finite group in a frame, and how far the given rotations are from its elements at most."""

    name: GroupName
    frame_wxyz: Floats
    misfit_deg: float


def recognise(info: Mapping[str, Any]) -> Recognised:
    """The closed group of a `models_info.json` entry.

    Additional keys are ignored, unless they are nearly the name of a field: then its symmetries would be lost.

    Raises:
        UserError: not a rotation (reflection, scaling, NaN), a zero axis, rotations that fit no group of at most 120
            elements, no common fixed point, a misspelt field.
    """
    if not isinstance(info, Mapping):
        raise UserError(f"{shown(info)} is not an entry of models_info.json, which maps field names to values")
    refuse_misspelt(info, _FIELDS)
    lines = [_line(item, i) for i, item in enumerate(_listed(info, "symmetries_continuous"))]
    discrete = _listed(info, "symmetries_discrete")
    if len(discrete) > _MOST_LISTED:
        raise UserError(f"symmetries_discrete lists {len(discrete)} rotations; a finite group has at most {MAX_ORDER}")
    motions = [_motion(item, i) for i, item in enumerate(discrete)]
    if lines:
        (name, frame), misfit = _continuous(lines, motions), 0.0
    else:
        name, frame, misfit = recognise_finite([m.rotation_wxyz for m in motions])
    offset = _fixed_point(name, frame, lines, motions, _offset_tolerance_mm(info, motions, misfit))
    return Recognised(name, frame, offset, tuple(_remarks(name, frame, offset, misfit)))


def refuse_misspelt(mapping: Mapping[Any, Any], known: Collection[str]) -> None:
    """Refuse keys that nearly are one of the known ones, such as `symmetry_discrete` or `discrete_symmetries`.

    Raises:
        UserError: with the key, and the one that was probably meant.
    """
    for key in mapping:
        if key not in known:
            written, sorted_words = _spellings(str(key))
            for name in known:
                right, right_sorted = _spellings(name)
                if _are_close(written, right) or _are_close(sorted_words, right_sorted):
                    raise UserError(f"unknown key {str(key)!r}: did you mean {name!r}?")


def _spellings(key: str) -> tuple[str, str]:
    """A key as it is written, but for case and hyphens, and with its words sorted."""
    plain = key.lower().replace("-", "_")
    return plain, "_".join(sorted(plain.split("_")))


def _are_close(one: str, other: str) -> bool:
    return difflib.SequenceMatcher(None, one, other).ratio() >= 0.75


def recognise_finite(rotations: Sequence[Floats]) -> Placement:
    """The group that unit quaternions (4,) generate, each of them perhaps off by some noise.

    Of the frames that describe the same group the one nearest to the identity is taken.

    Raises:
        UserError: they fit no group of at most 120 elements, or several.
    """
    given = np.reshape([q for q in rotations if angle_deg(q, np.array(IDENTITY)) > NOISE_DEG], (-1, 4))
    if not len(given):
        return Placement(GroupName("C", 1), np.array(IDENTITY), 0.0)
    placements = sorted(_placements(given), key=lambda p: (p.name.order, p.misfit_deg))
    fitting = [p for p in placements if p.misfit_deg <= tolerance_deg(p.name)]
    if not fitting:
        raise UserError(_no_group(given, placements))
    best = fitting[0]
    rivals = [p for p in fitting if p.misfit_deg <= _exact_deg(p.name)]
    if best.misfit_deg > max(SILENT_DEG, _exact_deg(best.name)) and rivals:
        raise UserError(
            f"symmetries_discrete are {best.misfit_deg:.2f} degrees off {best.name.text}, and fit "
            f"{rivals[0].name.text}: they are too inaccurate to tell the group; {_WRITE_A_TABLE}"
        )
    return best._replace(frame_wxyz=_nearest_frame(best))


def tolerance_deg(name: GroupName) -> float:
    """By how much, in degrees, a rotation may be off the nearest element of a group that a file means by it.

    So that noise of 0.5 degrees never turns a C_n with n <= 12, a D_n with n <= 6, T, O or I into another of them: the
    turns of two such C_n are at least 2.7 degrees apart, and the generators of O are at least 1.4 degrees off I.
    """
    limits = _CYCLIC_DEG if name.family == "C" else _OTHER_DEG
    rough = next((limit for order, limit in limits.items() if _largest_order(name) <= order), 0.0)
    return max(rough, _exact_deg(name))


def _exact_deg(name: GroupName) -> float:
    """What rounding may explain. A turn by a fraction with a large denominator n is near every angle: hence n^2."""
    return float(np.degrees(min(5e-3, 0.1 / _largest_order(name) ** 2)))


def _largest_order(name: GroupName) -> int:
    return {"T": 3, "O": 4, "I": 5}.get(name.family, name.n)


def _placements(given: Floats) -> Iterator[Placement]:
    """Every finite group that could have the given rotations (N, 4), where they fit it best."""
    yield from _cyclic(given)
    areas = np.linalg.norm(cross(given[:, None, 1:], given[None, :, 1:]), axis=-1)
    i, j = np.unravel_index(np.argmax(areas), areas.shape)
    if areas[i, j] < np.sin(np.radians(FIT_DEG)) * np.linalg.norm(given[i, 1:]) * np.linalg.norm(given[j, 1:]):
        return
    yield from _dihedral(given)
    for name in _POLYHEDRAL:
        if (placement := _polyhedral(name, given, int(i), int(j))) is not None:
            yield placement


def _cyclic(given: Floats) -> Iterator[Placement]:
    """C_2 to C_120 about the axis that the vector parts fit best: theirs are the errors that count."""
    axis = _principal_axes(given)[2]
    angles = np.asarray(2 * np.arctan2(given[:, 1:] @ axis, given[:, 0]))
    orders = np.arange(2, MAX_ORDER + 1)
    turns = _nearest_turns(angles, np.asarray(2 * np.pi / orders))
    off_deg = np.degrees(np.abs(turns - angles).max(axis=1))
    misfits = angle_deg(from_axis_angle(axis, turns), given).max(axis=1)
    for n, off, misfit in zip(orders.tolist(), off_deg.tolist(), misfits.tolist(), strict=True):
        if n <= 6 or off <= _TURN_DEG:
            yield Placement(GroupName("C", n), frame_of_axis(axis), misfit)


def _dihedral(given: Floats) -> Iterator[Placement]:
    """D_2 to D_60, each about the main axis where the rotations fit it best."""
    orders = np.arange(2, MAX_ORDER // 2 + 1)
    fits = [fit for axis in _main_axes(given) if (fit := _dihedral_about(axis, orders, given)) is not None]
    if fits:
        frames, misfits = (np.stack(values) for values in zip(*fits, strict=True))
        for k, axis in enumerate(np.argmin(misfits, axis=0).tolist()):
            yield Placement(GroupName("D", int(orders[k])), frames[axis, k], float(misfits[axis, k]))


def _main_axes(given: Floats) -> Iterator[Floats]:
    """Where the main axis may be: the rotations about it and across it make it a principal axis of the vector parts,
    and if that does not settle it, it is one of the given axes."""
    tried: list[Floats] = []
    for start in [*_principal_axes(given), *normalise(given[:, 1:])]:
        if all(abs(float(start @ other)) < _NEW_AXIS for other in tried):
            tried.append(start)
            about = np.abs(normalise(given[:, 1:]) @ start) > _ACROSS
            signed = np.where(about, 1.0, -1.0)[:, None] * given[:, 1:]
            yield np.asarray(np.linalg.eigh(signed.T @ given[:, 1:])[1][:, -1])


def _dihedral_about(axis: Floats, orders: NDArray[np.int64], given: Floats) -> tuple[Floats, Floats] | None:
    """Frames (K, 4) and misfits (K,) of D_n, n of K orders, about a main axis; None if no rotation is across it."""
    frame = frame_of_axis(axis)
    local = multiply(multiply(conjugate(frame), given), frame)
    about = np.abs(normalise(local[:, 1:])[:, 2]) > _ACROSS
    if about.all():
        return None
    azimuths = np.arctan2(local[~about, 2], local[~about, 1])
    phases = np.angle(np.exp(2j * orders[:, None] * azimuths).mean(axis=1)) / (2 * orders)
    steps = np.pi / orders[:, None]
    ideal = np.empty((len(orders), len(given), 4))
    turns = 2 * np.arctan2(local[about, 3], local[about, 0])
    ideal[:, about] = from_axis_angle(Z, _nearest_turns(turns, np.asarray(2 * np.pi / orders)))
    flips = phases[:, None] + np.round((azimuths - phases[:, None]) / steps) * steps
    ideal[:, ~about] = np.stack([0 * flips, np.cos(flips), np.sin(flips), 0 * flips], axis=-1)
    return multiply(frame, from_axis_angle(Z, phases)), angle_deg(ideal, local).max(axis=1)


def _polyhedral(name: GroupName, given: Floats, i: int, j: int) -> Placement | None:
    """T, O or I in the frame that takes two of its elements to the given rotations i and j and fits the others best."""
    ideal = standard_elements(name)[1:]
    one, other = given[i], given[j]
    axes = normalise(ideal[:, 1:])
    between = np.degrees(np.arccos(np.clip(np.abs(axes @ axes.T), 0, 1)))
    wanted = np.degrees(np.arccos(np.clip(abs(float(normalise(one[1:]) @ normalise(other[1:]))), 0, 1)))
    turns = angle_deg(ideal, np.array(IDENTITY))
    alike = [np.abs(turns - angle_deg(q, np.array(IDENTITY))) < _MATCHED_DEG for q in (one, other)]
    matched = alike[0][:, None] & alike[1][None] & (np.abs(between - wanted) < _MATCHED_DEG) & (between > FIT_DEG)
    a, b = np.nonzero(matched)
    if not len(a):
        return None
    target = _triads(one[None, 1:], other[None, 1:])
    sources = np.concatenate([_triads(axes[a], sign * axes[b]) for sign in (1, -1)])
    frames = from_matrix(target @ np.swapaxes(np.concatenate([sources, sources * [-1, 1, -1]]), 1, 2))
    some = given[np.unique(np.r_[i, j, : min(len(given), _TRIED)])]
    best = frames[np.argmin(_misfits_deg(frames, ideal, some))]
    frame = _fitted_frame(best, ideal, given)
    return Placement(name, frame, float(_misfits_deg(frame[None], ideal, given)[0]))


def _triads(u: Floats, v: Floats) -> Floats:
    """Rotation matrices (N, 3, 3) whose columns are u, what of v is perpendicular to it, and their cross product."""
    x, z = normalise(u), normalise(cross(u, v))
    return np.stack([x, cross(z, x), z], axis=-1)


def _principal_axes(given: Floats) -> Floats:
    """(3, 3): unit axes in rows, the one that the vector parts point along most is the last."""
    return np.asarray(np.linalg.eigh(given[:, 1:].T @ given[:, 1:])[1].T)


def _nearest_turns(angles: Floats, steps: Floats) -> Floats:
    """(S, N): for each of the steps (S,) the multiples, but 0, that are nearest to angles (N,)."""
    multiples = np.round(angles / steps[:, None])
    return np.asarray(np.where(multiples == 0, np.sign(angles), multiples) * steps[:, None])


def _misfits_deg(frames: Floats, ideal: Floats, given: Floats) -> Floats:
    """(F,): how far the given rotations (N, 4) are at most from the ideal elements (M, 4) in each frame (F, 4)."""
    local = multiply(multiply(conjugate(frames)[:, None], given), frames[:, None])
    return np.asarray(np.degrees(2 * np.arccos(np.clip(np.abs(local @ ideal.T), 0, 1))).min(axis=2).max(axis=1))


def _fitted_frame(frame: Floats, ideal: Floats, given: Floats) -> Floats:
    """The rotation that takes the elements' vector parts to the given ones (Kabsch), from a frame nearly right."""
    local = multiply(multiply(conjugate(frame), given), frame)
    matched = ideal[np.argmin(angle_deg(local[:, None], ideal[None]), axis=1)]
    matched *= np.where(np.sum(matched * local, axis=1, keepdims=True) < 0, -1.0, 1.0)
    U, _, Vt = np.linalg.svd(given[:, 1:].T @ matched[:, 1:])
    return np.asarray(from_matrix((U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt)[None])[0])


def _nearest_frame(placement: Placement) -> Floats:
    """Of the frames that describe the same group the one nearest to the identity."""
    name, frame, _ = placement
    if name.family == "C":
        return frame
    equal_frames = multiply(frame, standard_elements(_normaliser(name)))
    return np.asarray(equal_frames[np.argmax(np.abs(equal_frames @ _AMONG_EQUALS))])


def _normaliser(name: GroupName) -> GroupName:
    """The rotations that map the group onto itself: frames that differ by one of them describe the same group."""
    if name.family == "D":
        return GroupName("D", 2 * name.n) if name.n > 2 else GroupName("O", 0)
    return GroupName("I" if name.family == "I" else "O", 0)


def _no_group(given: Floats, placements: Sequence[Placement]) -> str:
    nearest = min(placements, key=lambda p: p.misfit_deg / tolerance_deg(p.name))
    text = (
        f"symmetries_discrete fit no group of at most {MAX_ORDER} rotations; the nearest, {nearest.name.text}, is "
        f"{nearest.misfit_deg:.2f} degrees off"
    )
    axis = _principal_axes(given)[2]
    across = np.linalg.norm(cross(axis, given[:, 1:]), axis=1)
    if float(across.max()) < np.sin(np.radians(FIT_DEG)):
        offered = _group_text("SO(2)", frame_of_axis(axis))
        return f"{text}. They all turn about one axis: for a solid of revolution write {offered}"
    return f"{text}: {_WRITE_A_TABLE}"


def _remarks(name: GroupName, frame: Floats, offset: Floats, misfit_deg: float) -> Iterator[str]:
    if misfit_deg > SILENT_DEG:
        yield f"symmetries_discrete are up to {misfit_deg:.2f} degrees off {name.text}, to which they are snapped"
    if name.family == "C" and name.n >= MANY_TURNS:
        yield (
            f"symmetries_discrete turn in steps of {360 / name.n:.3g} degrees: for a solid of revolution write "
            f"{_group_text('SO(2)', frame, offset)} into a symmetry table, or declare symmetries_continuous"
        )


def _group_text(name: str, frame: Floats, offset: Floats | None = None) -> str:
    def listed(vector: Floats) -> str:
        return "[" + ", ".join(f"{value + 0.0:.6g}" for value in np.round(vector, 9)) + "]"

    given = {"group": name, "axis": listed(rotate(frame, Z))} | ({} if offset is None else {"offset": listed(offset)})
    return "{" + ", ".join(f"{key}: {value}" for key, value in given.items()) + "}"


def _listed(info: Mapping[str, Any], key: str) -> Sequence[Any]:
    value = info.get(key)
    if value is None:
        return []
    if isinstance(value, str | Mapping) or not isinstance(value, Sequence):
        raise UserError(f"{key} is {shown(value)}, not a list")
    return value


def _numbers(value: object, size: int, what: str) -> Floats:
    try:
        numbers = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if len(numbers) != size or not np.isfinite(numbers).all():
        raise UserError(f"{what} is {shown(value)}, not {size} finite numbers")
    return numbers


def _line(item: object, i: int) -> Line:
    what = f"symmetries_continuous[{i}]"
    if isinstance(item, Mapping):
        refuse_misspelt(item, ("axis", "offset"))
    if not isinstance(item, Mapping) or "axis" not in item:
        raise UserError(f"{what} is {shown(item)}, not an {{axis, offset}} pair")
    axis = _numbers(item["axis"], 3, f"{what}: axis")
    if np.linalg.norm(axis) < 1e-9:
        raise UserError(f"{what}: axis is zero; a symmetry axis needs a direction, such as [0, 0, 1]")
    offset = item.get("offset")
    return Line(normalise(axis), _numbers((0, 0, 0) if offset is None else offset, 3, f"{what}: offset"))


def _motion(item: object, i: int) -> Motion:
    what = f"symmetries_discrete[{i}]"
    matrix = _numbers(item, 16, what).reshape(4, 4)
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        raise UserError(f"{what} has the last row {matrix[3].tolist()}, not [0, 0, 0, 1]: it is not a rigid motion")
    return Motion(from_matrix(matrix[None, :3, :3], name=lambda _: what)[0], matrix[:3, 3])


def _continuous(lines: Sequence[Line], motions: Sequence[Motion]) -> tuple[GroupName, Floats]:
    cosines = [abs(float(line.axis @ lines[0].axis)) for line in lines]
    if min(cosines) < np.cos(np.radians(FIT_DEG)):
        return GroupName("SO(3)", 0), np.array(IDENTITY)
    axis = lines[0].axis
    family: Family = "SO(2)"
    for i, motion in enumerate(motions):
        cosine = float(rotate(motion.rotation_wxyz, axis) @ axis)
        if abs(cosine) < np.cos(np.radians(2 * FIT_DEG)):
            raise UserError(
                f"symmetries_discrete[{i}] tilts the continuous axis by {np.degrees(np.arccos(cosine)):.1f} degrees: "
                "it must keep or reverse it (give a second continuous axis for a sphere)"
            )
        family = "O(2)" if cosine < 0 else family
    return GroupName(family, 0), frame_of_axis(axis)


def _offset_tolerance_mm(info: Mapping[str, Any], motions: Sequence[Motion], misfit_deg: float) -> float:
    """By how much the motions may miss a common fixed point: rounding grows with the object and with how far it lies
    from the origin, and a rotation that was snapped moves a far axis along."""
    try:
        diameter = float(info.get("diameter") or 0.0)
    except (TypeError, ValueError):
        diameter = 0.0  # others judge it
    farthest = max((float(np.abs(m.translation_mm).max()) for m in motions), default=0.0)
    share = 1e-3 + float(np.radians(misfit_deg))
    return 0.1 + share * farthest + 2e-3 * (diameter if np.isfinite(diameter) and diameter > 0 else 0.0)


def _fixed_point(
    name: GroupName, frame: Floats, lines: Sequence[Line], motions: Sequence[Motion], tolerance_mm: float
) -> Floats:
    """The point nearest the origin that all given motions keep, by least squares."""
    axis = rotate(frame, Z)
    rows: list[Floats] = []
    sides: list[Floats] = []
    for line in lines:
        direction = line.axis if name.family == "SO(3)" else axis
        across = np.eye(3) - np.outer(direction, direction)
        rows.append(across)
        sides.append(across @ line.point_mm)
    for motion in motions:
        rows.append(np.eye(3) - to_matrix(_ideal_rotation(name, frame, motion.rotation_wxyz)))
        sides.append(motion.translation_mm)
    if not rows:
        return np.zeros(3)
    matrix, side = np.concatenate(rows), np.concatenate(sides)
    point = np.linalg.lstsq(matrix, side, rcond=1e-6)[0]
    residual = float(np.abs(matrix @ point - side).max())
    if residual > tolerance_mm:
        raise UserError(
            f"the symmetries have no common fixed point (they miss one by {residual:.3g} mm): rotations about "
            "axes that meet are needed, without a shift along the axis"
        )
    return np.asarray(point)


def _ideal_rotation(name: GroupName, frame: Floats, q: Floats) -> Floats:
    """The element of the group nearest to a noisy one."""
    if name.family == "SO(3)":
        return q
    standard = multiply(multiply(conjugate(frame), q), frame)
    if name.family in ("SO(2)", "O(2)"):
        # Keep the part that is a turn about z, or a half turn about an axis across z.
        part = [standard[0], 0, 0, standard[3]] if abs(standard[0]) + abs(standard[3]) > 0.5 else [0, *standard[1:3], 0]
        ideal = normalise(np.array(part))
    else:
        elements = standard_elements(name)
        ideal = elements[np.argmin(angle_deg(elements, standard))]
    return multiply(multiply(frame, ideal), conjugate(frame))
