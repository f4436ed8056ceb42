"""Which symmetry group a mesh has: the largest one whose images lie within the tolerance of the mesh."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.symmetry.detection.candidates import MAX_FOLD, Candidate, CandidateSearch, same
from synthetless.symmetry.detection.distance import PIECE, Surface
from synthetless.symmetry.detection.refine import placed, refined, simplified, tightened
from synthetless.symmetry.detection.residual import GroupFit, Residual, ResidualMeter
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.quaternions import Floats

TIME_LIMIT_S = 120.0
"""How long a mesh may take; the usual one takes two seconds."""

MOST_TRIED = 12
"""The largest order that is tried about the axis of a continuous group which costs too much."""

_NEAR_TOLERANCE = 2.0  # a residual within this many tolerances may be brought below it by another placement
_WORTH_ANOTHER_PLACE = 0.01  # the share of a residual that another placement must save
_OF_INTEREST = 12.0  # a next larger group that costs more tolerances than this is told without a closer look
_STEPS = 4  # smaller groups that are looked for below the next larger one
_REFINED_POINTS = 300
_MOST_REFINED = 40
_CLEARLY_WITHIN = 0.7  # of the tolerance: a group whose estimated residual is at most this is within it
_SMALLER_REFINED = 4  # smaller groups that may fit better than one that is within the tolerance
_LARGER_MEASURED = 4  # unlikely groups that are measured all the same, to tell what they would cost
_BETTER, _BETTER_WITHIN = 0.95, 0.5  # a smaller group is reported only if its residual is below this share of a larger
# one's (of one within the tolerance)
_NEGLIGIBLE = 0.1  # a residual below this share of the tolerance leaves no reason to look at smaller groups


@dataclass(frozen=True)
class Detected:
    """What was found on one mesh.

    Attributes:
        diameter_mm: largest distance between two vertices.
        tolerance_mm: what the largest residual may be.
        fits: everything that was measured, smaller groups first, the best of each name and axis; always with C1.
        declared: the group that models_info.json gives, as it stands there, if it does.
        is_complete: whether everything was looked at; if not, time ran out, and there may be larger groups.
    """

    diameter_mm: float
    tolerance_mm: float
    fits: tuple[GroupFit, ...]
    declared: GroupFit | None
    is_complete: bool = True

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
    time_limit_s: float = TIME_LIMIT_S,
) -> Detected:
    """Detect the symmetry group of a mesh.

    A group that is near the tolerance, or the next larger one, is judged where its largest residual is smallest.

    Args:
        vertices_mm: (V, 3).
        faces: (F, 3) vertex numbers.
        diameter_mm: largest distance between two vertices.
        tolerance_percent: what the largest residual may be, as a share of the diameter.
        declared: a group whose residual is wanted, as it stands.
        time_limit_s: after this time no other group is looked at. Only what `Detected.is_complete` denies depends on
            the machine.

    Raises:
        UserError: no triangle has an area.
    """
    deadline = time.monotonic() + time_limit_s
    surface = Surface(vertices_mm, faces, PIECE * diameter_mm)
    meter = ResidualMeter(surface, vertices_mm, diameter_mm)
    return _Detector(surface, meter, tolerance_percent / 100 * diameter_mm, deadline).detect(declared)


def measure(vertices_mm: Floats, faces: NDArray[np.integer[Any]], diameter_mm: float, group: SymmetryGroup) -> GroupFit:
    """How far a mesh is from having a group, as it stands; arguments and errors as in `detect`."""
    surface = Surface(vertices_mm, faces, PIECE * diameter_mm)
    return GroupFit(group, ResidualMeter(surface, vertices_mm, diameter_mm).measure(group, diameter_mm))


class _Detector:
    def __init__(self, surface: Surface, meter: ResidualMeter, tolerance_mm: float, deadline: float) -> None:
        self._surface, self._meter, self._tolerance = surface, meter, tolerance_mm
        self._points = surface.sampled(_REFINED_POINTS)
        self._deadline = deadline
        self._is_complete = True

    def detect(self, declared: SymmetryGroup | None) -> Detected:
        fits = [GroupFit(SymmetryGroup.trivial(), Residual(0.0, 0.0, 0.0))]
        for group, estimate in self._promising():
            if self._has_time() and not self._is_superseded(group, estimate, fits):
                fits.append(self._near_tolerance(self._fit(simplified(group, self._meter))))
        fits = self._with_smaller_steps(fits)
        given = None
        if declared is not None:
            given = self._fit(declared)
            if given not in fits:
                fits.append(given)
        return self._detected(fits, given)

    def _detected(self, fits: list[GroupFit], declared: GroupFit | None = None) -> Detected:
        fits = sorted(fits, key=lambda f: (size(f.group), f.residual.max_mm))
        return Detected(self._meter.diameter_mm, self._tolerance, tuple(fits), declared, self._is_complete)

    def _has_time(self) -> bool:
        self._is_complete = self._is_complete and time.monotonic() < self._deadline
        return self._is_complete

    def _near_tolerance(self, fit: GroupFit) -> GroupFit:
        """The fit, tightened where that may bring it within the tolerance."""
        if self._tolerance < fit.residual.max_mm <= _NEAR_TOLERANCE * self._tolerance:
            return self._tightened(fit)
        return fit

    def _tightened(self, fit: GroupFit) -> GroupFit:
        tight = tightened(fit, self._surface, self._meter, self._tolerance)
        if tight.residual.max_mm > (1 - _WORTH_ANOTHER_PLACE) * fit.residual.max_mm:
            return fit  # in the place that is easier to read
        return tight

    def _with_smaller_steps(self, fits: list[GroupFit]) -> list[GroupFit]:
        """The fits with the next larger group tightened, and with what is smaller and costs less about its axis."""
        seen: list[GroupFit] = []
        while self._has_time() and len(seen) < _STEPS:
            found = self._detected(fits)
            larger = found.next_larger
            if larger is None or larger in seen or larger.residual.max_mm > _OF_INTEREST * self._tolerance:
                break
            tight = larger if larger.residual.max_mm <= _NEAR_TOLERANCE * self._tolerance else self._tightened(larger)
            seen.append(tight)
            fits = [tight if fit == larger else fit for fit in fits]
            smaller = self._cheapest_about(tight, size(found.answer.group))
            if smaller is not None:
                fits.append(smaller)
        return fits

    def _cheapest_about(self, fit: GroupFit, larger_than: float) -> GroupFit | None:
        """Of the smaller C_n and D_n about a group's axis the one that costs least, if that is clearly less."""
        group = fit.group
        if group.axis is None or group.family in ("T", "O", "I"):
            return None
        most = MOST_TRIED if not group.is_finite else int(group.order) - 1
        names = [f"C{n}" for n in range(2, min(most, MAX_FOLD) + 1) if larger_than < n]
        if group.family == "D":
            names += [f"D{n}" for n in range(2, group.main_order) if larger_than < 2 * n]
        offset = np.array(group.offset_mm)
        trials = [placed(name, group.frame_wxyz, offset) for name in names]
        estimates = [self._meter.estimate(trial) for trial in trials]
        if not trials or min(estimates) > _BETTER * fit.residual.max_mm:
            return None
        trial, _ = self._refined(trials[int(np.argmin(estimates))])
        found = self._near_tolerance(self._fit(simplified(trial, self._meter)))
        return found if found.residual.max_mm < _BETTER * fit.residual.max_mm else None

    def _promising(self) -> list[tuple[SymmetryGroup, float]]:
        """Refined groups, larger ones first, and first estimates of their residuals in mm."""
        sphere = self._refined(SymmetryGroup("SO(3)", offset_mm=tuple(self._surface.centroid)))
        if sphere[1] < _CLEARLY_WITHIN * self._tolerance:  # there is nothing larger
            return [sphere]
        meter = self._meter
        search = CandidateSearch(self._surface, meter.diameter_mm, self._tolerance, meter.dense, self._has_time)
        candidates = search.candidates()
        likely = [c for c in candidates if c.is_likely]
        unlikely = [c for c in candidates if not c.is_likely]
        found: list[tuple[SymmetryGroup, float]] = []
        rest = sorted(likely, key=lambda c: (-size(c.group), c.misfit_mm))[:_MOST_REFINED]
        while rest and self._has_time() and not any(estimate < _NEGLIGIBLE * self._tolerance for _, estimate in found):
            found.append(self._refined(rest.pop(0).group))
            if found[-1][1] < _CLEARLY_WITHIN * self._tolerance:
                rest = sorted(rest, key=lambda c: c.misfit_mm)[:_SMALLER_REFINED]
        found += [self._refined(c.group) for c in _rising(unlikely) if self._has_time()]
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
