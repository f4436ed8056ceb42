"""How likely a deviation as large as the one seen is, had the recipe been kept: p-values.

None where there are too few values to judge.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Floats = NDArray[np.float64]

FEWEST_VALUES = 20
_FEWEST_EXPECTED = 5.0  # in each category, for the chi-squared approximation to hold
_MOST_BINS = 24
_ROUNDING = 1e-9


def uniform_p(values: Floats, low: float, high: float) -> float | None:
    """Whether values are uniform in [low, high]; 0 if one lies outside.

    Kolmogorov and Smirnov's test, which sees a slope or a shift, and Pearson's over bins, which sees a gap or a peak;
    the smaller p-value counts, twice, since there are two (Bonferroni).
    """
    slack = _ROUNDING * max(1.0, abs(low), abs(high))
    if values.size and (values.min() < low - slack or values.max() > high + slack):
        return 0.0
    if values.size < FEWEST_VALUES or high - low <= slack:
        return None
    bins = min(_MOST_BINS, int(values.size // _FEWEST_EXPECTED))
    counts = np.histogram(np.clip(values, low, high), bins, (low, high))[0]
    binned = float(stats.chisquare(counts).pvalue)
    return min(1.0, 2 * min(binned, float(stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue)))


def categories_p(counts: Sequence[int], expected: Sequence[float], repeats: float = 1.0) -> float | None:
    """Whether counts are those of independent draws with the expected frequencies: Pearson's chi-squared test.

    Args:
        counts: of each category.
        expected: of each category, with the same sum; 0 for what must not occur.
        repeats: how often each draw was counted.
    """
    found, wanted = np.array(counts) / repeats, np.array(expected) / repeats
    if (found[wanted == 0] > 0).any():
        return 0.0
    found, wanted = found[wanted > 0], wanted[wanted > 0]
    if len(wanted) < 2 or wanted.min() < _FEWEST_EXPECTED:
        return None
    return float(stats.chi2.sf(((found - wanted) ** 2 / wanted).sum(), len(wanted) - 1))


def rotations_p(wxyz: Floats) -> float | None:
    """Whether rotations, quaternions (N, 4), are uniform on SO(3): Bingham's test of the axes +-q in four dimensions.

    S = p(p + 2)/2 n (tr T^2 - 1/p), T the mean of q q^T, is chi-squared with (p - 1)(p + 2)/2 degrees of freedom
    (Mardia and Jupp, Directional Statistics, 2000, section 10.7.1), here with p = 4.
    """
    if len(wxyz) < FEWEST_VALUES:
        return None
    q = wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    scatter = q.T @ q / len(q)
    return float(stats.chi2.sf(12 * len(q) * (np.trace(scatter @ scatter) - 0.25), 9))
