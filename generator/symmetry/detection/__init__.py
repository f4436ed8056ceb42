"""Detection of symmetry groups from meshes: see `detect` for the method, `folder` for whole folders."""

from synthetless.symmetry.detection.detect import Detected, detect
from synthetless.symmetry.detection.folder import (
    DetectedFolder,
    DetectedObject,
    Tolerance,
    detect_folder,
    parse_tolerances,
)
from synthetless.symmetry.detection.report import report
from synthetless.symmetry.detection.residual import GroupFit, Residual

__all__ = [
    "Detected",
    "DetectedFolder",
    "DetectedObject",
    "GroupFit",
    "Residual",
    "Tolerance",
    "detect",
    "detect_folder",
    "parse_tolerances",
    "report",
]
