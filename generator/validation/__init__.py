"""Is a dataset what it claims to be? Every file, every label, and both against each other.

``validate`` reads everything that a dataset consists of and reports each fault with its file, image, instance and
what was expected; nothing is changed.

* ``run`` hands scene folders to workers, ``report`` holds what they find.
* ``structure``: dataset.json, models, symmetries, and which files there must be; ``records``: the JSON files.
* ``images``: the files of an image against each other; ``recompute``: against what is measured again.
* ``foreign``: datasets that others made and ``adopt`` labelled; ``exports``: shards and COCO files.
"""

from synthetless.validation.report import KINDS, Finding, Report
from synthetless.validation.run import SAMPLE, validate

__all__ = ["KINDS", "SAMPLE", "Finding", "Report", "validate"]
