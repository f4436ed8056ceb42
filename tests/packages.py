"""Packages that read the exports and that are too large to be installed everywhere."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import pytest


def package_or_skip(name: str, where: str = "extra 'interop' has it") -> Any:
    """A package; skips the test where it is not installed."""
    return pytest.importorskip(name, reason=f"{name.partition('.')[0]} is not installed; {where}")


def torchvision_or_skip() -> Any:
    """torchvision; its data sets alone where its compiled operators do not fit the build of torch (CPU or CUDA)."""
    torch = package_or_skip("torch")
    try:
        return package_or_skip("torchvision")
    except RuntimeError:  # "operator torchvision::nms does not exist"
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        for name in ("nms", "qnms"):
            torch.library.define(f"torchvision::{name}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        return importlib.import_module("torchvision")
