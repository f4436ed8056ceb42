"""Detection of symmetry groups from meshes: see `detect` for the method, `folder` for whole folders."""

from generator.symmetry.detection.detect import Detected, Finding, detect
from generator.symmetry.detection.folder import DetectedFolder, DetectedObject, detect_folder
from generator.symmetry.detection.report import report
from generator.symmetry.detection.residual import Residual

__all__ = [
    "Detected",
    "DetectedFolder",
    "DetectedObject",
    "Finding",
    "Residual",
    "detect",
    "detect_folder",
    "report",
]
