"""What a dataset holds, beside what its recipe asked for: a bias shows before a network learns it."""

from synthetless.preview.statistics.distributions import Distribution
from synthetless.preview.statistics.summary import ClassStatistics, Statistics, statistics

__all__ = ["ClassStatistics", "Distribution", "Statistics", "statistics"]
