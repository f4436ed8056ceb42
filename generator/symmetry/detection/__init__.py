"""Detection of symmetry groups from meshes: see `detect` for the method, `folder` for whole folders."""

from synthetless.symmetry.detection.detect import Detected, GroupFit, detect
from synthetless.symmetry.detection.folder import DetectedFolder, DetectedObject, detect_folder
from synthetless.symmetry.detection.report import report
from synthetless.symmetry.detection.residual import Residual

__all__ = [
    "Detected",
    "DetectedFolder",
    "DetectedObject",
    "GroupFit",
    "Residual",
    "detect",
    "detect_folder",
    "report",
]
