"""The pages themselves: templates filled in, with everything that comes from a dataset escaped."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import as_file, files
from itertools import groupby
from pathlib import Path
from typing import Any

from synthetless.dataset.palette import css_color
from synthetless.errors import UserError
from synthetless.extras import MissingExtraError
from synthetless.io.files import atomic_write, read_bytes, read_json
from synthetless.preview.image import Drawn
from synthetless.preview.plots import plots
from synthetless.preview.statistics import Statistics

PAGE_FILE, STATISTICS_PAGE, STATISTICS_FILE = "index.html", "statistics.html", "statistics.json"
DRAWN_FILE = "drawn.json"
STATIC_FILES = ("preview.css", "gallery.js", "zoom.js", "viewer.js")
_FILES = {PAGE_FILE, DRAWN_FILE, STATISTICS_FILE, STATISTICS_PAGE, "data/index.js", *STATIC_FILES}
_DATA_FILE = re.compile(
    r"(data/\d{6,}/\d{6,}\.js|thumbnails/\d{6,}/\d{6,}\.jpg|plots/\w+\.svg"
    r"|images/\d{6,}/\d{6,}-(rgb|depth|normals)\.jpg)"
)
_FEW_IMAGES = 100  # for charts of every class: below, they are folded
_GROUPS = ("labels", "objects", "camera", "light", "table", "image")
_PACKAGE = "synthetless.preview"
_MARK = '<meta name="generator" content="synthetless preview">'


def refuse_others(folder: Path) -> None:
    """Keep a new preview from replacing anything but a former one.

    Raises:
        UserError: the folder is there, and it is a file or holds something that no preview writes.
    """
    if not folder.exists():
        return
    page = folder / PAGE_FILE
    files = [path for path in sorted(folder.rglob("*")) if path.is_symlink() or not path.is_dir()]
    if not folder.is_dir() or (files and not page.is_file()) or (page.is_file() and _MARK not in _text(page)):
        raise UserError(f"{folder}: exists already and is not a preview; give a new or an empty folder")
    for path in files:
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or not (name in _FILES or _DATA_FILE.fullmatch(name)):
            raise UserError(f"{folder}: holds {name}, which no preview writes; move it away, or give another folder")


def _text(page: Path) -> str:
    return read_bytes(page).decode("utf-8", errors="replace")


def read_drawn(folder: Path) -> dict[str, Drawn]:
    """What a former preview has drawn of each image, by its key; nothing if it does not say."""
    try:
        content = read_json(folder / DRAWN_FILE)
        return {key: Drawn(digest, tuple(files)) for key, (digest, files) in content.items() if _known(files)}
    except (UserError, AttributeError, TypeError, ValueError):
        return {}


def _known(files: Any) -> bool:
    return all(_DATA_FILE.fullmatch(name) for name in files)


def write_drawn(folder: Path, drawn: Mapping[str, Drawn]) -> None:
    """Keep what was drawn of each image, for the next preview.

    Raises:
        UserError: it cannot be written.
    """
    content = {key: [each.digest, each.files] for key, each in drawn.items()}
    atomic_write(folder / DRAWN_FILE, json.dumps(content, separators=(",", ":")).encode())


def write_pages(folder: Path, title: str, split: str, images: int) -> None:
    """Write the gallery's page and what it needs beside the data.

    Raises:
        UserError: the extra that brings the templates is not installed, or a file cannot be written.
    """
    atomic_write(folder / PAGE_FILE, render("gallery.html", title=title, split=split, images=images).encode())
    for name in STATIC_FILES:
        with as_file(files(_PACKAGE) / "static" / name) as path:
            shutil.copyfile(path, folder / name)


@dataclass(frozen=True)
class Summary:
    """The statistics and their plots as SVG, by name."""

    statistics: Statistics
    plots: Mapping[str, bytes]

    @classmethod
    def of(cls, found: Statistics) -> Summary:
        """Draw them.

        Raises:
            UserError: matplotlib is not installed.
        """
        return cls(found, dict(plots(found)))


def write_statistics(folder: Path, title: str, summary: Summary, names: Mapping[int, str]) -> None:
    """Write the page of the statistics, its plots, and the numbers as JSON; ``names`` are the objects', by id.

    Raises:
        UserError: as ``write_pages``.
    """
    of = summary.statistics
    content = json.dumps(of.to_json(), indent=1, allow_nan=False)
    atomic_write(folder / STATISTICS_FILE, f"{content}\n".encode())
    for name, svg in summary.plots.items():
        atomic_write(folder / "plots" / f"{name}.svg", svg)
    ordered = sorted(of.distributions, key=lambda each: _GROUPS.index(each.group))
    groups = [(group, list(members)) for group, members in groupby(ordered, key=lambda each: each.group)]
    page = render(
        "statistics.html",
        title=title,
        of=of,
        groups=groups,
        names=names,
        recipe=of.drops > 0,
        few=_FEW_IMAGES,
        colour=css_color,
    )
    atomic_write(folder / STATISTICS_PAGE, page.encode())


def render(template: str, **values: Any) -> str:
    """A template filled in; every value is escaped.

    Raises:
        UserError: the extra that brings the templates is not installed.
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError:
        raise MissingExtraError("jinja2") from None
    environment = Environment(
        loader=PackageLoader("synthetless.preview"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
