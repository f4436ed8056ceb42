"""models/ against dataset.json and against itself."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from synthetless.dataset.records import Entry
from synthetless.io.files import read_bytes
from synthetless.io.models import INFO_FILE, load_models, read_models_info
from synthetless.symmetry import SymmetryGroup
from synthetless.validation.geometry import Shape
from synthetless.validation.report import Finding, bare, unusable
from synthetless.validation.schemas import ModelInfo, faults

_INFO = TypeAdapter(ModelInfo)

_SLACK_MM, _SLACK = 0.5, 0.01
"""BOP's boxes and diameters are rounded, some are of a simplified mesh: so much, and this share, they may be off."""


@dataclass(frozen=True, eq=False)
class Models:
    """A models folder.

    Attributes:
        infos: models_info.json by object id.
        shapes: of the meshes that can be read.
        findings: what is wrong with them.
    """

    infos: Mapping[int, Entry]
    shapes: Mapping[int, Shape]
    findings: tuple[Finding, ...]


def read_models(folder: Path, digests: Mapping[int, str]) -> Models:
    """Read and check a models folder; ``digests`` are the SHA-256 of the PLY files the dataset was made of."""
    path = folder / INFO_FILE
    infos, findings = read_infos(path)
    if infos:
        for obj_id in sorted(infos.keys() ^ digests.keys()):
            there = "an entry" if obj_id in infos else "no usable entry"
            findings.append(Finding("models", path, f"has {there} for object {obj_id}; dataset.json says otherwise"))
    shapes: dict[int, Shape] = {}
    for obj_id, digest in sorted(digests.items()):
        findings += _check_digest(_mesh(folder, obj_id), digest)
        if obj_id in infos and _mesh(folder, obj_id).exists():
            try:
                shapes[obj_id] = Shape.of(load_models(folder, (obj_id,))[obj_id].vertices_mm)
            except ValueError as error:
                findings.append(Finding("models", _mesh(folder, obj_id), bare(error, _mesh(folder, obj_id))))
            else:
                findings += _check_info(path, obj_id, infos[obj_id], shapes[obj_id])
    findings += _check_strangers(folder, {path, *(_mesh(folder, obj_id) for obj_id in digests)})
    return Models(infos, shapes, tuple(findings))


def read_infos(path: Path) -> tuple[dict[int, Entry], list[Finding]]:
    """The entries of models_info.json that have the right form, and what is wrong with the others."""
    try:
        infos = read_models_info(path.parent)
    except ValueError as error:
        return {}, [unusable(path, error)]
    good: dict[int, Entry] = {}
    findings: list[Finding] = []
    for obj_id, info in infos.items():
        bad = [Finding("schema", path, f"object {obj_id}: {fault.message}") for fault in faults(_INFO, info)]
        findings += bad or _check_symmetries(path, obj_id, info)
        if not bad:
            good[obj_id] = info
    return good, findings


def _check_symmetries(path: Path, obj_id: int, info: Entry) -> list[Finding]:
    """BOP's readers take an object's symmetries from models_info.json."""
    try:
        SymmetryGroup.from_bop(info)
    except (ValueError, TypeError, KeyError) as error:
        return [Finding("models", path, f"object {obj_id}: its symmetries are no rotation group ({error})")]
    return []


def _mesh(folder: Path, obj_id: int) -> Path:
    return folder / f"obj_{obj_id:06d}.ply"


def _check_digest(path: Path, digest: str) -> Iterator[Finding]:
    if not path.exists():
        yield Finding("missing", path, "not there; dataset.json names it")
    elif (found := hashlib.sha256(read_bytes(path)).hexdigest()) != digest:
        yield Finding("models", path, f"has SHA-256 {found[:12]}...; the dataset was made of {digest[:12]}...")


def _check_info(path: Path, obj_id: int, info: Entry, shape: Shape) -> Iterator[Finding]:
    """Box and diameter of an object against its mesh."""
    size = shape.high_mm - shape.low_mm
    slack = _SLACK_MM + _SLACK * size.max()
    measured = {f"min_{axis}": value for axis, value in zip("xyz", shape.low_mm, strict=True)}
    measured |= {f"size_{axis}": value for axis, value in zip("xyz", size, strict=True)}
    for key, value in measured.items():
        if not abs(info[key] - value) <= slack:
            yield Finding("models", path, f"object {obj_id} has {key} {info[key]}; its mesh has {value:.3f} mm")
    low, high = float(size.max()), float(np.linalg.norm(size))
    if not low - slack <= info["diameter"] <= high + slack:
        yield Finding(
            "models",
            path,
            f"object {obj_id} has diameter {info['diameter']}; its mesh allows {low:.3f} to {high:.3f} mm",
        )


def _check_strangers(folder: Path, known: set[Path]) -> Iterator[Finding]:
    if folder.is_dir():
        for path in sorted(set(folder.iterdir()) - known):
            yield Finding("stray", path, "is none of the models that dataset.json names")
