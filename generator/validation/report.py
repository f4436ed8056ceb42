"""What a validation found: each fault with its file, image, instance and expectation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

Kind = Literal[
    "missing",  # a file, an image or an export member that should be there
    "stray",  # a file that belongs to nothing
    "unreadable",  # cut off, damaged, or neither JSON nor an image
    "schema",  # JSON of another form
    "ids",  # files that disagree about which images and instances there are
    "counts",  # dataset.json's totals
    "picture",  # an image of another size or kind
    "models",  # models/ against dataset.json and models_info.json
    "symmetries",  # symmetries.json itself
    "camera",  # cameras against the recipe and against scene_spec.jsonl
    "pose",  # invalid poses, or poses that scene_spec.jsonl contradicts
    "spec",  # scene_spec.jsonl against the plan and scene_gt.json
    "record",  # .records/ against the JSON files that were assembled from them
    "gt_info",  # counts, fractions and boxes
    "mask",  # masks against each other and against recomputed ones
    "depth",  # depth against recomputed depth
    "geometry",  # normals and object coordinates against recomputed ones
    "coco",  # scene_gt_coco.json
    "canonical",  # labels that do not follow from poses and symmetries
    "stale",  # labels of other symmetries
    "export",  # an export that differs from its source
]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class Finding:
    """One fault.

    Attributes:
        kind: of fault.
        file: where it is.
        message: what is there and what was expected.
        image: BOP image id within its scene folder.
        instance: gt_id within the image.
    """

    kind: Kind
    file: Path
    message: str
    image: int | None = None
    instance: int | None = None


def bare(error: Exception, path: Path) -> str:
    """An error's message without the file's name, which a finding states anyway."""
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path}, ")


def unusable(path: Path, error: Exception) -> Finding:
    """The finding for a file that cannot be read."""
    if not path.exists():
        return Finding("missing", path, "not there")
    if path.stat().st_size == 0:
        return Finding("unreadable", path, "is empty: zero bytes")
    return Finding("unreadable", path, bare(error, path))


class Tally:
    """Findings of one part of a dataset: every one is counted, the first of each kind are kept."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.counts: Counter[Kind] = Counter()
        self.kept: list[Finding] = []
        self._n_kept: Counter[Kind] = Counter()

    def add(self, findings: Iterable[Finding]) -> bool:
        """Take findings; whether there were none."""
        before = self.counts.total()
        for finding in findings:
            self.counts[finding.kind] += 1
            self._keep(finding)
        return self.counts.total() == before

    def merge(self, other: Tally) -> None:
        """Take another part's findings, after one's own."""
        self.counts += other.counts
        for finding in other.kept:
            self._keep(finding)

    def _keep(self, finding: Finding) -> None:
        if self._n_kept[finding.kind] < self.limit:
            self._n_kept[finding.kind] += 1
            self.kept.append(finding)


@dataclass(frozen=True)
class Report:
    """The result of a validation.

    Attributes:
        root: the dataset's folder.
        images, instances: how many were looked at.
        recomputed_images: how many were made again from the recorded scenes and compared, apart from their light.
        exports: what was compared with the dataset.
        findings: the first faults of each kind.
        counts: of all faults, by kind.
        notes: what could not be checked, and why.
    """

    root: Path
    images: int
    instances: int
    recomputed_images: int
    exports: tuple[Path, ...]
    findings: tuple[Finding, ...]
    counts: dict[str, int]
    notes: tuple[str, ...] = ()

    @property
    def valid(self) -> bool:
        """Whether nothing is wrong."""
        return not self.counts

    def lines(self) -> list[str]:
        """For people: faults grouped by kind, then the sum."""
        lines: list[str] = []
        for kind, count in self.counts.items():
            shown = [finding for finding in self.findings if finding.kind == kind]
            lines += [f"{kind}: {self._place(finding)}: {finding.message}" for finding in shown]
            if count > len(shown):
                lines.append(f"{kind}: ... and {count - len(shown)} more")
        lines += [f"note: {note}" for note in self.notes]
        recomputed = f", {self.recomputed_images} of them recomputed" if self.recomputed_images else ""
        exports = f", {len(self.exports)} exports" if self.exports else ""
        faults = sum(self.counts.values())
        verdict = "valid" if self.valid else f"{faults} fault{'s' if faults > 1 else ''}"
        return [
            *lines,
            f"{self.root}: {self.images} images{recomputed}, {self.instances} instances{exports}: {verdict}",
        ]

    def to_json(self) -> dict[str, Any]:
        """For scripts: plain values."""
        return {
            "dataset": str(self.root),
            "valid": self.valid,
            "images": self.images,
            "instances": self.instances,
            "recomputed_images": self.recomputed_images,
            "exports": [str(path) for path in self.exports],
            "counts": self.counts,
            "findings": [
                {
                    "kind": finding.kind,
                    "file": self._relative(finding.file),
                    "image": finding.image,
                    "instance": finding.instance,
                    "message": finding.message,
                }
                for finding in self.findings
            ],
            "notes": list(self.notes),
        }

    def _place(self, finding: Finding) -> str:
        image = "" if finding.image is None else f", image {finding.image}"
        instance = "" if finding.instance is None else f", instance {finding.instance}"
        return f"{self._relative(finding.file)}{image}{instance}"

    def _relative(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix() if path.is_relative_to(self.root) else str(path)
