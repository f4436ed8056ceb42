"""What a dataset holds, beside what its recipe asked for: a bias shows before a network learns it."""

from generator.review.statistics.distributions import Distribution
from generator.review.statistics.summary import ClassStatistics, Statistics, statistics

__all__ = ["ClassStatistics", "Distribution", "Statistics", "statistics"]
