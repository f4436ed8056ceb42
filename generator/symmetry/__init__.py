"""Symmetry groups of rigid objects and the labels that respect them. NumPy only."""

from synthetless.symmetry.canonical import CanonicalMap, CanonicalPoses
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.table import QuasiSymmetry, SymmetryEntry, SymmetryTable

__all__ = ["CanonicalMap", "CanonicalPoses", "QuasiSymmetry", "SymmetryEntry", "SymmetryGroup", "SymmetryTable"]
