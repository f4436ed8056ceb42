"""Symmetry groups of rigid objects and the labels that respect them. NumPy only."""

from generator.symmetry.groups import SymmetryGroup
from generator.symmetry.mapping import CanonicalMap, CanonicalPoses
from generator.symmetry.table import SymmetryEntry, SymmetryTable

__all__ = ["CanonicalMap", "CanonicalPoses", "SymmetryEntry", "SymmetryGroup", "SymmetryTable"]
