"""Where drops are made on a Ray cluster: processes on many machines, each of which may be lost at any moment."""

from synthetless.generation.cluster.crew import run

__all__ = ["run"]
