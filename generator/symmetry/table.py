"""The symmetry table: which group each object of a dataset has, as a file that a person or a program writes.

By hand (YAML or JSON):

    object 26: {group: C2, axis: [0, 0, 1], offset: [-7, 0, 0]}
    object 27: {group: C4}
    object 31: {group: D3, axis: [0, 0, 1], secondary_axis: [1, 0, 0]}
    object 14: {group: C1, quasi: {group: SO(2), axis: [0, 0, 1], tolerance_mm: 2}}

`quasi` is a larger group that the object has but for a detail no larger than `tolerance_mm`, which may be left out.

As `symmetries.json` beside a dataset: {"scheme", "allocentric", "objects": {id: entry}}, and "decimals" if the poses
that are labelled were rounded to less than 15 of them. An entry also says what follows from the group: order ("inf" for
a continuous one), n_regressors, anchors (unit quaternions wxyz, in the role of `R_m2c`), separation_deg.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from typing_extensions import Self

from synthetless.errors import UserError
from synthetless.io.documents import read_document, shown
from synthetless.io.files import atomic_write
from synthetless.io.models import INFO_FILE
from synthetless.symmetry.atlas import SCHEMES, Scheme, former_anchors
from synthetless.symmetry.canonical import FULL_DECIMALS, CanonicalMap, check_decimals
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.point_groups import parse_name

Matrix = tuple[tuple[float, ...], ...]

TABLE_FILE = "symmetries.json"

TABLE_KEYS = ("scheme", "allocentric", "decimals", "objects")

_GIVEN_KEYS = ("group", "axis", "secondary_axis", "frame", "offset", "offset_mm", "reference_rotation", "quasi")
_QUASI_KEYS = ("group", "axis", "secondary_axis", "frame", "offset", "offset_mm", "tolerance_mm")
_DERIVED_KEYS = ("order", "n_regressors", "anchors", "separation_deg")
_BOP_SIZES = tuple(f"{what}_{axis}" for what in ("min", "max", "size") for axis in "xyz")
_BOP_KEYS = ("symmetries_discrete", "symmetries_continuous", "diameter", *_BOP_SIZES)
_SAME_POINT_MM = 0.01
"""By how much fixed points written by hand may miss each other."""
_OBJECT_KEY = re.compile(r"(?:object\s*|obj_?)?0*(\d+)", re.IGNORECASE)


@dataclass(frozen=True)
class QuasiSymmetry:
    """A group that an object has but for a detail, which an image may or may not show.

    Attributes:
        group: larger than the exact one.
        tolerance_mm: the largest residual that was accepted when the group was chosen; None if it is not known.
    """

    group: SymmetryGroup
    tolerance_mm: float | None = None

    def __post_init__(self) -> None:
        if self.tolerance_mm is not None and not 0 < self.tolerance_mm < math.inf:
            raise UserError(f"tolerance_mm of quasi is {self.tolerance_mm}; a number of mm > 0 is needed")


@dataclass(frozen=True)
class SymmetryEntry:
    """One object's symmetries.

    Attributes:
        group: the symmetry group.
        reference_rotation: what the first regressor is centred on, three rows of three; None for the identity.
        quasi: a larger group that the object nearly has, if one was chosen.

    Raises:
        UserError: the quasi-symmetry group is not larger, or does not contain the group.
    """

    group: SymmetryGroup
    reference_rotation: Matrix | None = None
    quasi: QuasiSymmetry | None = None

    def __post_init__(self) -> None:
        if self.quasi is None:
            return
        larger, apart_mm = self.quasi.group, self.quasi.tolerance_mm or _SAME_POINT_MM
        if not larger.contains(self.group, apart_mm=apart_mm):
            raise UserError(
                f"quasi is {_placed(larger)}, which does not contain the group {_placed(self.group)}: every symmetry "
                "is a quasi-symmetry too, about the same axis and fixed point"
            )
        if self.group.contains(larger, apart_mm=apart_mm):
            raise UserError(f"quasi is {larger.name}, the group itself: give a larger one, or leave quasi out")

    def canonical_map(self, scheme: Scheme, allocentric: bool = False, decimals: int = FULL_DECIMALS) -> CanonicalMap:
        """The map that labels this object's poses."""
        return CanonicalMap(self.group, scheme, self.reference_rotation, allocentric, decimals)


@dataclass(frozen=True)
class SymmetryTable:
    """The symmetries of all objects and the scheme they are labelled by.

    Attributes:
        entries: by object id, ascending.
        scheme: `pitteri2019` or `atlas`.
        allocentric: whether rotations are judged relative to the ray to the object (see `CanonicalMap`).
        decimals: with how many the poses that are labelled are stored (see `CanonicalMap`).
    """

    entries: Mapping[int, SymmetryEntry]
    scheme: Scheme = "pitteri2019"
    allocentric: bool = False
    decimals: int = FULL_DECIMALS

    def __post_init__(self) -> None:
        check_decimals(self.decimals)
        _check_scheme(self.scheme)
        ordered = {obj_id: self.entries[obj_id] for obj_id in sorted(self.entries)}
        object.__setattr__(self, "entries", MappingProxyType(ordered))

    def __reduce__(self) -> tuple[type[SymmetryTable], tuple[Any, ...]]:
        return SymmetryTable, (dict(self.entries), self.scheme, self.allocentric, self.decimals)

    @classmethod
    def from_models_info(cls, models_info: object, scheme: Scheme = "pitteri2019", allocentric: bool = False) -> Self:
        """The table of the groups that BOP's `models_info.json` declares (keys: object ids as int or str).

        Raises:
            UserError: an entry that describes no rotation group, with the object's id.
        """
        declared, faults = cls.declared(models_info, scheme=scheme, allocentric=allocentric)
        if faults:
            raise UserError(next(iter(faults.values())))
        return declared

    @classmethod
    def declared(
        cls,
        models_info: object,
        but: Collection[int] = (),
        scheme: Scheme = "pitteri2019",
        allocentric: bool = False,
    ) -> tuple[Self, dict[int, str]]:
        """The table of those groups in BOP's `models_info.json` that can be read, and what is wrong with the others.

        Args:
            models_info: the file's content.
            but: objects whose entries are not looked at.
            scheme, allocentric: of the table.

        Returns:
            The table, and one line for each object whose entry describes no rotation group, by id.

        Raises:
            UserError: it is not a mapping of object ids to entries, or names an object twice.
        """
        entries, faults = {}, {}
        for obj_id, info in _by_id(models_info, f"{INFO_FILE} maps object ids to diameters and boxes").items():
            if obj_id not in but:
                try:
                    entries[obj_id] = SymmetryEntry(SymmetryGroup.from_bop(info, f"object {obj_id}"))
                except UserError as error:
                    faults[obj_id] = f"object {obj_id}: {error}"
        return cls(entries, scheme, allocentric), faults

    @classmethod
    def from_dict(cls, data: object) -> Self:
        """The table of parsed YAML or JSON, in either form of the module's description, or of a whole
        `models_info.json`.

        Raises:
            UserError: unknown keys or groups (with the nearest known name), or values that describe no rotation
                group.
        """
        if not isinstance(data, Mapping):
            raise UserError(
                "a symmetry table is a mapping of objects, such as 'object 26: {group: C2, axis: [0, 0, 1]}'"
            )
        objects = data.get("objects", {key: value for key, value in data.items() if key not in TABLE_KEYS})
        if "objects" in data:
            _refuse_unknown(data, TABLE_KEYS, "the symmetry table")
        scheme, allocentric = data.get("scheme", SCHEMES[0]), data.get("allocentric", False)
        _check_scheme(scheme)
        if not isinstance(allocentric, bool):
            raise UserError(f"allocentric is {shown(allocentric)}, not true or false")
        entries = {}
        by_id = _by_id(objects, f"objects is {shown(objects)}, not a mapping of object ids to groups")
        for obj_id, value in by_id.items():
            try:
                entries[obj_id] = _entry(value, scheme, f"object {obj_id}")
            except UserError as error:
                raise UserError(f"object {obj_id}: {error}") from error
        return cls(entries, scheme, allocentric, data.get("decimals", FULL_DECIMALS))

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """The table in a YAML or JSON file, in BOP's `models_info.json`, or in a folder that holds one of these.

        Of a folder `symmetries.json` is taken, or else `models_info.json`.

        Raises:
            UserError: the file cannot be found or read, is neither JSON nor YAML, or what `from_dict` refuses; with
                the file's name.
        """
        file = _file_of(Path(path))
        content = read_document(file)
        try:
            return cls.from_models_info(content) if file.name == INFO_FILE else cls.from_dict(content)
        except UserError as error:
            raise UserError(f"{file}: {error}") from error

    def write(self, path: str | Path) -> None:
        """Write the table as JSON (which is YAML as well), always the same bytes, whole or not at all.

        Raises:
            UserError: the file cannot be written.
        """
        content = self.to_dict()
        head = [f'"{key}": {json.dumps(content[key])}' for key in content if key != "objects"]
        lines = [f"  {json.dumps(key)}: {json.dumps(entry)}" for key, entry in content["objects"].items()]
        text = "{\n" + ",\n".join(head) + ',\n"objects": {\n' + ",\n".join(lines) + "\n}}\n"
        atomic_write(Path(path), text.encode(), durable=True)

    def to_dict(self) -> dict[str, Any]:
        """What `write` writes: plain dicts, lists and numbers."""
        objects = {str(obj_id): self._described(entry) for obj_id, entry in self.entries.items()}
        head: dict[str, Any] = {"scheme": self.scheme, "allocentric": self.allocentric}
        if self.decimals < FULL_DECIMALS:
            head["decimals"] = self.decimals
        return head | {"objects": objects}

    def digest(self) -> str:
        """SHA-256 (hex) of the table's canonical JSON: equal digests, equal labels."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()

    def canonical_map(self, obj_id: int) -> CanonicalMap:
        """The map that labels an object's poses.

        Raises:
            UserError: the table does not have the object.
        """
        if obj_id not in self.entries:
            raise UserError(f"object {obj_id} is not in the symmetry table, which has {_listed(self.entries)}")
        return self.entries[obj_id].canonical_map(self.scheme, self.allocentric, self.decimals)

    def quasi_map(self, obj_id: int) -> CanonicalMap:
        """The map that labels an object's poses as if it had its quasi-symmetry group.

        Raises:
            UserError: the table does not have the object, or no such group of it.
        """
        own = self.canonical_map(obj_id)
        quasi = self.entries[obj_id].quasi
        if quasi is None:
            raise UserError(f"object {obj_id} has no quasi-symmetry group in the symmetry table")
        return replace(own, group=quasi.group)

    def _described(self, entry: SymmetryEntry) -> dict[str, Any]:
        described = _described_group(entry.group)
        if entry.reference_rotation is not None:
            described["reference_rotation"] = [list(row) for row in entry.reference_rotation]
        if entry.quasi is not None:
            described["quasi"] = _described_quasi(entry.quasi)
        return described | _derived(entry, self.scheme)


def _described_group(group: SymmetryGroup) -> dict[str, Any]:
    described: dict[str, Any] = {"group": group.name}
    described |= {"axis": None if group.axis is None else list(group.axis)}
    if group.secondary_axis is not None:
        described["secondary_axis"] = list(group.secondary_axis)
    described["offset_mm"] = list(group.offset_mm)
    return described


def _described_quasi(quasi: QuasiSymmetry) -> dict[str, Any]:
    described = _described_group(quasi.group)
    return described if quasi.tolerance_mm is None else described | {"tolerance_mm": quasi.tolerance_mm}


def _placed(group: SymmetryGroup) -> str:
    """A group's name and place, for messages."""
    axis = "" if group.axis is None else f" about {list(group.axis)}"
    return f"{group.name}{axis}" + (f" through {list(group.offset_mm)}" if any(group.offset_mm) else "")


def _derived(entry: SymmetryEntry, scheme: Scheme) -> dict[str, Any]:
    canonical = entry.canonical_map(scheme)
    return {
        "order": int(entry.group.order) if entry.group.is_finite else "inf",
        "n_regressors": canonical.n_regressors,
        "anchors": canonical.anchors_wxyz.tolist(),
        "separation_deg": canonical.separation_deg,
    }


def _by_id(objects: object, otherwise: str) -> dict[int, Any]:
    """The values of a mapping by object id."""
    if not isinstance(objects, Mapping):
        raise UserError(otherwise)
    by_id: dict[int, Any] = {}
    for key, value in objects.items():
        obj_id = object_id(key)
        if obj_id in by_id:
            raise UserError(f"object {obj_id} is listed twice")
        by_id[obj_id] = value
    return by_id


def _entry(value: object, scheme: Scheme, what: str) -> SymmetryEntry:
    if isinstance(value, str):
        return SymmetryEntry(SymmetryGroup.from_name(value))
    if not isinstance(value, Mapping):
        raise UserError(f"{shown(value)} describes no symmetries; write for example {{group: C2, axis: [0, 0, 1]}}")
    if "group" not in value and not value.keys().isdisjoint(_BOP_KEYS):
        return SymmetryEntry(SymmetryGroup.from_bop(value, what))
    _refuse_unknown(value, _GIVEN_KEYS + _DERIVED_KEYS, "it", suggested=_BOP_KEYS)
    quasi = None if value.get("quasi") is None else _quasi(value["quasi"])
    entry = SymmetryEntry(_group(value), _reference(value.get("reference_rotation")), quasi)
    _check_derived(value, entry, scheme)
    return entry


def _group(value: Mapping[Any, Any]) -> SymmetryGroup:
    if "group" not in value:
        raise UserError("it has no group; write for example {group: C2, axis: [0, 0, 1]}")
    if "offset" in value and "offset_mm" in value:
        raise UserError("offset and offset_mm are the same thing: give one of them")
    offset = value.get("offset_mm", value.get("offset"))
    return SymmetryGroup.from_name(
        value["group"],
        axis=value.get("axis"),
        secondary_axis=value.get("secondary_axis"),
        offset_mm=(0, 0, 0) if offset is None else offset,
        frame=value.get("frame"),
    )


def _quasi(value: object) -> QuasiSymmetry:
    if isinstance(value, str):
        return QuasiSymmetry(SymmetryGroup.from_name(value))
    if not isinstance(value, Mapping):
        raise UserError(
            f"quasi is {shown(value)}; write for example {{group: SO(2), axis: [0, 0, 1], tolerance_mm: 2}}"
        )
    _refuse_unknown(value, _QUASI_KEYS, "quasi")
    try:
        group = _group(value)
    except UserError as error:
        raise UserError(f"quasi: {error}") from error
    tolerance = value.get("tolerance_mm")
    if tolerance is not None and (isinstance(tolerance, bool) or not isinstance(tolerance, int | float)):
        raise UserError(f"tolerance_mm of quasi is {shown(tolerance)}; a number of mm > 0 is needed")
    return QuasiSymmetry(group, None if tolerance is None else float(tolerance))


def _reference(value: object) -> Matrix | None:
    if value is None:
        return None
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.size != 9:
        raise UserError(f"reference_rotation is {shown(value)}, not 3 rows of 3 numbers")
    rows = matrix.reshape(3, 3)
    CanonicalMap(SymmetryGroup.trivial(), reference_rotation=rows)  # refuses what is no rotation
    return tuple(tuple(float(number) for number in row) for row in rows)


def _check_derived(given: Mapping[Any, Any], entry: SymmetryEntry, scheme: Scheme) -> None:
    """A file whose group was edited must not keep saying what followed from the former one."""
    expected = _derived(entry, scheme)
    wrong = [key for key in _DERIVED_KEYS if key in given and not _agree(given[key], expected[key])]
    if wrong and not _is_of_earlier_version(given, wrong, entry, scheme):
        raise UserError(f"{wrong[0]} does not follow from the group and scheme: leave {', '.join(_DERIVED_KEYS)} out")


def _is_of_earlier_version(given: Mapping[Any, Any], wrong: list[str], entry: SymmetryEntry, scheme: Scheme) -> bool:
    """Whether the file was right when it was written: its group stands, only its labels have to be made again."""
    if scheme != "pitteri2019" or not {"anchors"} <= set(wrong) <= {"anchors", "separation_deg"}:
        return False
    return _agree(
        given["anchors"], entry.canonical_map(scheme).placed_wxyz(former_anchors(parse_name(entry.group.name)))
    )


def _agree(a: object, b: object) -> bool:
    if isinstance(a, str) or isinstance(b, str):
        return a == b
    try:
        left, right = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return left.shape == right.shape and bool(np.allclose(left, right, atol=1e-9))


def object_id(key: object) -> int:
    """The id in `26`, `object 26` or `obj_000026`.

    Raises:
        UserError: there is none.
    """
    matched = _OBJECT_KEY.fullmatch(str(key).strip())
    if matched is None:
        raise UserError(f"{key!r} names no object: write 'object 26' or 26{_suggestion(str(key), TABLE_KEYS)}")
    return int(matched[1])


def _refuse_unknown(
    mapping: Mapping[Any, Any], known: Sequence[str], where: str, suggested: Sequence[str] = ()
) -> None:
    for key in mapping:
        if key not in known:
            raise UserError(f"{where} has the unknown key {str(key)!r}{_suggestion(str(key), [*known, *suggested])}")


def _suggestion(word: str, known: Iterable[str]) -> str:
    nearest = difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f": did you mean {nearest[0]!r}?" if nearest else ""


def _file_of(path: Path) -> Path:
    if not path.is_dir():
        return path
    found = [path / name for name in (TABLE_FILE, INFO_FILE) if (path / name).exists()]
    if not found:
        raise UserError(f"{path}: holds neither {TABLE_FILE} nor {INFO_FILE}; symmetries detect can write a table")
    return found[0]


def _check_scheme(scheme: object) -> None:
    if scheme not in SCHEMES:
        raise UserError(f"unknown scheme {scheme!r}: use one of {', '.join(SCHEMES)}")


def _listed(ids: Iterable[int]) -> str:
    text = ", ".join(map(str, ids))
    return f"objects {text}" if text else "no objects"
