"""Is a dataset what it claims to be? Every file, every label, and both against each other.

``validate`` reads everything that a dataset consists of and reports each fault with its file, image, instance and
what was expected; nothing is changed. How the check is split: ``source`` (dataset.json, models, symmetries), ``scene``
(one folder, on a worker), and in it ``labels`` and ``files`` (structure), ``poses``, ``canonical``, ``coco``, and per
image ``pictures``, ``masks``, ``depth`` and ``surfaces``; ``deep`` casts rays; ``webdataset`` and ``coco_export``
compare exports. ``adopted`` does what it can with a dataset that others made and ``adopt`` labelled.
"""

from synthetless.validation.report import KINDS, Finding, Report
from synthetless.validation.run import validate

__all__ = ["KINDS", "Finding", "Report", "validate"]
