"""Which symmetry group a mesh has: the largest one whose images lie within the tolerance of the mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.symmetry.detection.candidates import Candidate, CandidateSearch, same
from synthetless.symmetry.detection.distance import PIECE, Surface
from synthetless.symmetry.detection.refine import refined, simplified
from synthetless.symmetry.detection.residual import Residual, ResidualMeter
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.quaternions import Floats

_REFINED_POINTS = 300
_MOST_REFINED = 40
_CLEARLY_WITHIN = 0.7  # of the tolerance: a group whose estimated residual is at most this is within it
_SMALLER_REFINED = 4  # smaller groups that may fit better than one that is within the tolerance
_LARGER_MEASURED = 4  # unlikely groups that are measured all the same, to tell what they would cost
_BETTER, _BETTER_WITHIN = 0.95, 0.5  # a smaller group is reported only if its residual is below this share of a larger
# one's (of one within the tolerance)
_NEGLIGIBLE = 0.1  # a residual below this share of the tolerance leaves no reason to look at smaller groups


@dataclass(frozen=True)
class GroupFit:
    """A group fitted to a mesh, and how far the mesh is from having it."""

    group: SymmetryGroup
    residual: Residual


@dataclass(frozen=True)
class Detected:
    """What was found on one mesh.

    Attributes:
        diameter_mm: largest distance between two vertices.
        tolerance_mm: what the largest residual may be.
        fits: everything that was measured, smaller groups first, the best of each name and axis; always with C1.
        declared: the group that models_info.json gives, as it stands there, if it does.
    """

    diameter_mm: float
    tolerance_mm: float
    fits: tuple[GroupFit, ...]
    declared: GroupFit | None

    @property
    def answer(self) -> GroupFit:
        """The largest group within the tolerance; of equally large ones the one that fits best."""
        return self.answer_at(self.tolerance_mm)

    def answer_at(self, tolerance_mm: float) -> GroupFit:
        """What the answer would be at another tolerance, of what was measured."""
        within = (f for f in self.fits if f.residual.max_mm <= tolerance_mm)
        return max(within, key=lambda f: (size(f.group), -f.residual.max_mm))

    @property
    def staircase(self) -> tuple[GroupFit, ...]:
        """The fits that are the answer at some tolerance, smaller groups first: no group as large fits as well."""
        steps: list[GroupFit] = []
        for fit in sorted(self.fits, key=lambda f: (-size(f.group), f.residual.max_mm)):
            least = min((f.residual.max_mm for f in steps), default=math.inf)
            tells_more = least > _NEGLIGIBLE * self.tolerance_mm and fit.residual.max_mm < _BETTER * least
            if tells_more or fit == self.answer:
                steps.append(fit)
        return tuple(reversed(steps))

    @property
    def next_larger(self) -> GroupFit | None:
        """The answer at the smallest tolerance that would change it."""
        answer = size(self.answer.group)
        return next((f for f in self.staircase if size(f.group) > answer), None)


def size(group: SymmetryGroup) -> float:
    """How large a group is: its order, and SO(2) < O(2) < SO(3) above all finite ones."""
    return {"SO(2)": 1e6, "O(2)": 2e6, "SO(3)": math.inf}.get(group.name, float(group.order))


def detect(
    vertices_mm: Floats,
    faces: NDArray[np.integer[Any]],
    diameter_mm: float,
    tolerance_percent: float = 1.0,
    declared: SymmetryGroup | None = None,
) -> Detected:
    """Detect the symmetry group of a mesh.

    Args:
        vertices_mm: (V, 3).
        faces: (F, 3) vertex numbers.
        diameter_mm: largest distance between two vertices.
        tolerance_percent: what the largest residual may be, as a share of the diameter.
        declared: a group whose residual is wanted, as it stands.

    Raises:
        UserError: no triangle has an area.
    """
    surface = Surface(vertices_mm, faces, PIECE * diameter_mm)
    meter = ResidualMeter(surface, vertices_mm, diameter_mm)
    return _Detector(surface, meter, tolerance_percent / 100 * diameter_mm).detect(declared)


def measure(vertices_mm: Floats, faces: NDArray[np.integer[Any]], diameter_mm: float, group: SymmetryGroup) -> GroupFit:
    """How far a mesh is from having a group, as it stands; arguments and errors as in `detect`."""
    surface = Surface(vertices_mm, faces, PIECE * diameter_mm)
    return GroupFit(group, ResidualMeter(surface, vertices_mm, diameter_mm).measure(group, diameter_mm))


class _Detector:
    def __init__(self, surface: Surface, meter: ResidualMeter, tolerance_mm: float) -> None:
        self._surface, self._meter, self._tolerance = surface, meter, tolerance_mm
        self._points = surface.sampled(_REFINED_POINTS)

    def detect(self, declared: SymmetryGroup | None) -> Detected:
        diameter = self._meter.diameter_mm
        fits = [GroupFit(SymmetryGroup.trivial(), Residual(0.0, 0.0, 0.0))]
        for group, estimate in self._promising():
            if not self._is_superseded(group, estimate, fits):
                fits.append(self._fit(simplified(group, self._meter)))
        given = None
        if declared is not None:
            given = self._fit(declared)
            if given not in fits:
                fits.append(given)
        fits.sort(key=lambda f: (size(f.group), f.residual.max_mm))
        return Detected(diameter, self._tolerance, tuple(fits), given)

    def _promising(self) -> list[tuple[SymmetryGroup, float]]:
        """Refined groups, larger ones first, and first estimates of their residuals in mm."""
        sphere = self._refined(SymmetryGroup("SO(3)", offset_mm=tuple(self._surface.centroid)))
        if sphere[1] < _CLEARLY_WITHIN * self._tolerance:  # there is nothing larger
            return [sphere]
        search = CandidateSearch(self._surface, self._meter.diameter_mm, self._tolerance, self._meter.dense)
        candidates = search.candidates()
        likely = [c for c in candidates if c.is_likely]
        unlikely = [c for c in candidates if not c.is_likely]
        found: list[tuple[SymmetryGroup, float]] = []
        rest = sorted(likely, key=lambda c: (-size(c.group), c.misfit_mm))[:_MOST_REFINED]
        while rest and not any(estimate < _NEGLIGIBLE * self._tolerance for _, estimate in found):
            found.append(self._refined(rest.pop(0).group))
            if found[-1][1] < _CLEARLY_WITHIN * self._tolerance:
                rest = sorted(rest, key=lambda c: c.misfit_mm)[:_SMALLER_REFINED]
        found += [self._refined(c.group) for c in _rising(unlikely)]
        return sorted(found, key=lambda pair: (-size(pair[0]), pair[1]))

    def _refined(self, group: SymmetryGroup) -> tuple[SymmetryGroup, float]:
        group = refined(group, self._surface, self._points, self._meter.diameter_mm)
        return group, self._meter.estimate(group)

    def _fit(self, group: SymmetryGroup) -> GroupFit:
        return GroupFit(group, self._meter.measure(group, self._tolerance))

    def _is_superseded(self, group: SymmetryGroup, estimate_mm: float, fits: list[GroupFit]) -> bool:
        """Whether a group that was measured is as large and fits as well, or well enough."""
        for fit in fits:
            largest = fit.residual.max_mm
            share = _BETTER_WITHIN if largest <= self._tolerance else _BETTER
            if size(fit.group) >= size(group) and (
                largest <= max(_NEGLIGIBLE * self._tolerance, estimate_mm / share) or same(fit.group, group)
            ):
                return True
        return False


def _rising(candidates: list[Candidate]) -> list[Candidate]:
    """Of candidates by rising misfit a few that each are larger than the former."""
    chosen: list[Candidate] = []
    for candidate in candidates:
        if len(chosen) < _LARGER_MEASURED and all(size(candidate.group) > size(c.group) for c in chosen):
            chosen.append(candidate)
    return chosen
