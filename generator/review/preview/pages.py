"""The pages themselves: templates filled in, with everything that comes from a dataset escaped."""

from __future__ import annotations

import shutil
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from generator.formats.files import atomic_write

PAGE_FILE = "index.html"
STATIC_FILES = ("preview.css", "gallery.js", "viewer.js")
_PACKAGE = "generator.review.preview"
_MARK = '<meta name="generator" content="synthetless preview">'


def is_ours(folder: Path) -> bool:
    """Whether a folder is empty or a preview, which a new one may replace."""
    page = folder / PAGE_FILE
    if not folder.is_dir():
        return False
    return _MARK in page.read_text(encoding="utf-8", errors="replace") if page.is_file() else not any(folder.iterdir())


def write_pages(folder: Path, title: str, split: str, images: int) -> None:
    """Write the gallery's page and what it needs beside the data.

    Raises:
        ValueError: the extra that brings the templates is not installed, or a file cannot be written.
    """
    atomic_write(folder / PAGE_FILE, render("gallery.html", title=title, split=split, images=images).encode())
    for name in STATIC_FILES:
        with as_file(files(_PACKAGE) / "static" / name) as path:
            shutil.copyfile(path, folder / name)


def render(template: str, **values: Any) -> str:
    """A template filled in; every value is escaped.

    Raises:
        ValueError: the extra that brings the templates is not installed.
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError:
        raise ValueError("a preview needs jinja2 and matplotlib: pip install 'synthetless[preview]'") from None
    environment = Environment(
        loader=PackageLoader("generator.review.preview"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(mark=_MARK, **values)
