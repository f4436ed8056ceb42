"""Pages of results: tables, curves as SVG, pictures. The same numbers give the same bytes."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from synthetless.extras import MissingExtraError
from synthetless.io.files import atomic_write

Curve = tuple[Sequence[float], Sequence[float]]
"""Abscissae and ordinates."""
_STYLE: Any = {
    "svg.hashsalt": "synthetless",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9.0,
    "text.parse_math": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
}


@dataclass(frozen=True)
class Section:
    """A part of a page; what is empty is left out.

    Attributes:
        title, text: heading and paragraph.
        columns, rows: a table.
        svg: a figure, as ``line_chart`` gives it.
        pictures: addresses of pictures, relative to the page.
    """

    title: str = ""
    text: str = ""
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    svg: bytes = b""
    pictures: Sequence[str] = ()


def write_page(path: Path, title: str, sections: Sequence[Section]) -> None:
    """Write a page, whole or not at all; everything but the figures is escaped.

    Raises:
        UserError: jinja2 is not installed, or the file cannot be written.
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError:
        raise MissingExtraError("jinja2") from None
    environment = Environment(
        loader=PackageLoader("synthetless.learning"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    atomic_write(path, environment.get_template("page.html").render(title=title, sections=sections).encode())


def line_chart(curves: Mapping[str, Curve], x: str, y: str, logarithmic: bool = False) -> bytes:
    """Curves by name as an SVG figure; ``x`` and ``y`` name the axes.

    Raises:
        UserError: matplotlib is not installed.
    """
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
        from matplotlib.ticker import StrMethodFormatter
    except ImportError:
        raise MissingExtraError("matplotlib") from None
    with rc_context(_STYLE):
        figure = Figure(figsize=(6.4, 3.4), layout="constrained")
        axes = figure.add_subplot()
        for name, (abscissae, ordinates) in curves.items():
            axes.plot(abscissae, ordinates, label=name, linewidth=1.5)
        axes.set_xlabel(x)
        axes.set_ylabel(y)
        if logarithmic:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))  # the others write mathematical text
            axes.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}"))
        else:
            axes.set_ylim(bottom=0)
        if len(curves) > 1:
            axes.legend()
        drawn = io.BytesIO()
        figure.savefig(drawn, format="svg", metadata={"Date": None})
    text = drawn.getvalue()
    return text[text.index(b"<svg") :]  # without the XML head, so that it can stand in a page
