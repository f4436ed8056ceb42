"""The statistics as SVG by matplotlib: the same numbers give the same bytes.

A plot has no background and is drawn for a light page; where the reader's colour scheme is dark, a style inside the
file lightens its ink.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import MissingExtraError
from synthetless.preview.distributions import Distribution
from synthetless.preview.statistics import (
    CELLS,
    NEAR_JUMP_DEG,
    ClassStatistics,
    DetailStatistics,
    Statistics,
    cell_outlines,
)
from synthetless.symmetry.atlas import SCHEMES, Scheme

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

_INK, _LIGHT_INK = "#41474e", "#c4cad1"
_BAR, _ASKED, _LINE = "#5b8fd6", "#e0862e", "#9aa1a9"
_REGRESSORS = ("#7b4fa3", "#4fa78a", "#d6c04a", "#b5486a", "#2f5d8a", "#8cae4a", "#b79fd6", "#7f8c99")
_SCHEMES: dict[Scheme, str] = {"pitteri2019": "#a3485c", "atlas": "#2e8b96"}
_TRUE, _CANONICAL = "#8d8f94", "#3d7a4a"
_STYLE: Any = {
    "svg.hashsalt": "synthetless",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 8.0,
    "text.parse_math": False,
    "text.color": _INK,
    "axes.edgecolor": _LINE,
    "axes.labelcolor": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.use_mathtext": False,
    "axes.unicode_minus": False,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "legend.frameon": False,
}
_DARK = (
    "<style>@media (prefers-color-scheme: dark) {"
    f'[style*="fill: {_INK}"] {{ fill: {_LIGHT_INK} !important }} '
    f'[style*="stroke: {_INK}"] {{ stroke: {_LIGHT_INK} !important }}'
    "}</style>"
)
_MOST_NAMES, _LONGEST_NAME = 40, 28
_LETTER_INCHES = 0.06
"""Width of a letter, about: names that stand on end get room of their own, or none is left for the bars."""


def plots(of: Statistics) -> Iterator[tuple[str, bytes]]:
    """Every plot's name and SVG, one after the other.

    Raises:
        UserError: matplotlib is not installed.
    """
    try:
        from matplotlib import rc_context
    except ImportError:
        raise MissingExtraError("matplotlib") from None
    with rc_context(_STYLE):
        for each in of.distributions:
            yield each.key, distribution_plot(each)
        if of.classes:
            yield "regressors", regressors_plot(of.classes)
            yield "near_jump", near_jump_plot(of.classes)
            yield "coverage", coverage_plot(of.classes)
        for each_class in of.classes:
            yield f"sphere_{each_class.obj_id}", sphere_plot(each_class)
            if each_class.detail is not None:
                yield f"detail_{each_class.obj_id}", detail_plot(each_class.views, each_class.detail)


def distribution_plot(of: Distribution) -> bytes:
    """Bars of what there is, a line of what was asked for."""
    names = [_short(name) for name in of.categories] if len(of.categories) <= _MOST_NAMES else []
    longest = max(map(len, names), default=0)
    upright = longest <= 3
    height = 2.0 if upright else 2.0 + _LETTER_INCHES * longest
    figure, axes = _figure(_width(len(of.categories)) if of.categories else 3.4, height)
    if of.categories:
        places = np.arange(len(of.counts), dtype=np.float64)
        axes.bar(places, of.counts, 0.8, color=_BAR)
        axes.set_xticks(places if names else [], names)
        if not upright:
            axes.tick_params(axis="x", labelrotation=90)
        edges = np.append(places - 0.5, len(places) - 0.5)
    else:
        edges = np.array(of.edges)
        axes.bar(edges[:-1], of.counts, np.diff(edges) * 0.92, align="edge", color=_BAR)
    if of.expected is not None:
        axes.stairs(of.expected, edges, color=_ASKED, linewidth=1.4, baseline=None)
    if of.bounds is not None:
        axes.axvspan(*of.bounds, color=_ASKED, alpha=0.15, linewidth=0)
    axes.set_xlim(edges[0], edges[-1])
    axes.yaxis.get_major_locator().set_params(integer=True)
    return _svg(figure)


def regressors_plot(classes: Sequence[ClassStatistics]) -> bytes:
    """Share of each regressor in a class's labels; ticks where uniformly random rotations would divide it."""
    figure, axes = _figure(10.4, 2.1)
    for place, each in enumerate(classes):
        start, random = 0.0, np.cumsum(each.regressors_random)[:-1] / each.instances
        for index, count in enumerate(each.regressors):
            share = count / each.instances
            axes.bar(place, share, 0.8, bottom=start, color=_REGRESSORS[index % len(_REGRESSORS)])
            start += share
        axes.hlines(random, place - 0.5, place + 0.5, color=_INK, linewidth=1.2)
    _class_axis(axes, classes)
    axes.set_ylim(0, 1)
    return _svg(figure)


def near_jump_plot(classes: Sequence[ClassStatistics]) -> bytes:
    """Percent of a class's labels near a discontinuity, under each scheme; lines for random rotations."""
    figure, axes = _figure(10.4, 2.1)
    places = np.arange(len(classes))
    for number, scheme in enumerate(SCHEMES):
        middle = places + 0.4 * (number - 0.5)
        color = _SCHEMES[scheme]
        axes.bar(middle, [100 * each.near_jump[scheme].share for each in classes], 0.36, color=color, label=scheme)
        random = [100 * each.near_jump[scheme].random for each in classes]
        axes.hlines(random, middle - 0.2, middle + 0.2, color=_INK, linewidth=1.2)
    _class_axis(axes, classes)
    axes.set_ylim(bottom=0, top=max(1.0, axes.get_ylim()[1]))
    axes.set_ylabel(f"% within {NEAR_JUMP_DEG:g}°")
    axes.legend(ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0)
    return _svg(figure)


def coverage_plot(classes: Sequence[ClassStatistics]) -> bytes:
    """Percent of the viewing sphere that is seen; lines for as many views uniform on the sphere."""
    figure, axes = _figure(10.4, 2.1)
    places = np.arange(len(classes))
    columns = (
        ("true pose", _TRUE, [c.coverage for c in classes]),
        ("canonical", _CANONICAL, [c.coverage_canonical for c in classes]),
    )
    for number, (name, color, shares) in enumerate(columns):
        axes.bar(places + 0.4 * (number - 0.5), 100 * np.array(shares), 0.36, color=color, label=name)
    axes.hlines([100 * c.coverage_uniform for c in classes], places - 0.4, places + 0.4, color=_INK, linewidth=1.2)
    _class_axis(axes, classes)
    axes.set_ylabel("% of cells")
    axes.legend(ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0)
    return _svg(figure)


def sphere_plot(of: ClassStatistics) -> bytes:
    """Two globes in Hammer's projection: from where the object is seen by its true and by its canonical pose."""
    figure, _ = _figure(3.4, 0.98, axes=False)
    for column, (title, views) in enumerate((("true", of.views), ("canonical", of.views_canonical))):
        counts = np.array(views)
        _globe(figure.add_subplot(1, 2, column + 1), title, counts, counts > 0, max(1, int(counts.max())))
    return _svg(figure)


def detail_plot(views: Sequence[Sequence[int]], detail: DetailStatistics) -> bytes:
    """A globe as in ``sphere_plot``: the share of the views from each cell that show the detail; and its scale."""
    figure, _ = _figure(3.4, 0.98, axes=False)
    counts = np.array(views)
    shares = np.array(detail.views_visible) / np.maximum(counts, 1)
    shown = _globe(figure.add_subplot(1, 2, 1), "detail visible", shares, counts > 0, 1.0)
    beside = figure.add_subplot(1, 2, 2)
    beside.set_axis_off()
    bar = figure.colorbar(
        shown, cax=beside.inset_axes((0.1, 0.5, 0.8, 0.1)), orientation="horizontal", ticks=[0, 0.5, 1]
    )
    bar.ax.set_xticklabels(["never", "half", "always"], fontsize=7)
    bar.ax.tick_params(length=2)
    bar.outline.set_edgecolor(_LINE)
    return _svg(figure)


def _globe(axes: Axes, title: str, values: NDArray[Any], shown: NDArray[np.bool_], most: float) -> PolyCollection:
    """Cells of the viewing sphere coloured by values (BANDS, SECTORS) from 0 to ``most``, if they are to be shown."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Ellipse

    cells, chosen = cell_outlines().reshape(CELLS, -1, 2), shown.ravel()
    drawn = PolyCollection(list(cells[chosen]), cmap="viridis_r", edgecolors="face", linewidths=0.2)
    drawn.set_array(values.ravel()[chosen])
    drawn.set_clim(0, most)
    axes.add_collection(drawn)
    axes.add_patch(Ellipse((0, 0), 4 * np.sqrt(2), 2 * np.sqrt(2), fill=False, edgecolor=_LINE, linewidth=0.8))
    axes.set(xlim=(-2.9, 2.9), ylim=(-1.47, 1.47), aspect="equal")
    axes.set_axis_off()
    axes.set_title(title, fontsize=7, pad=1)
    return drawn


def _short(name: str) -> str:
    """A name with its middle left out: files differ in their last letters as often as in their first."""
    half = _LONGEST_NAME // 2
    return name if len(name) <= _LONGEST_NAME else f"{name[: half - 1]}…{name[-half:]}"


def _width(classes: int) -> float:
    return 3.4 if classes <= 12 else 10.4


def _class_axis(axes: Axes, classes: Sequence[ClassStatistics]) -> None:
    axes.set_xticks(range(len(classes)), [str(each.obj_id) for each in classes] if len(classes) <= _MOST_NAMES else [])
    axes.set_xlim(-0.6, len(classes) - 0.4)


def _figure(width: float, height: float, axes: bool = True) -> tuple[Figure, Any]:
    """A figure of its own, outside pyplot's global state; inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    figure.patch.set_alpha(0)
    if not axes:
        return figure, None
    drawn = figure.add_subplot()
    drawn.patch.set_alpha(0)
    drawn.tick_params(length=2)
    return figure, drawn


def _svg(figure: Figure) -> bytes:
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    text = stream.getvalue()
    end = text.index(">", text.index("<svg")) + 1
    return (text[:end] + _DARK + text[end:]).encode()
