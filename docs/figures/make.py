"""The figures of docs/symmetry.md, computed by the code that they explain.

Run it from the repository's root: `python -m docs.figures.make` writes docs/images/symmetry_*; it needs the extra
`preview`.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from docs.figures import notch
from synthetless.annotation.instances import PosedModel
from synthetless.annotation.scene import scene_caster
from synthetless.io.models import ObjectModel, load_models
from synthetless.scenes.spec import Intrinsics
from synthetless.symmetry import CanonicalMap, CanonicalPoses, SymmetryGroup
from synthetless.symmetry.atlas import SCHEMES, Scheme

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / "docs" / "images"
C2 = SymmetryGroup.from_name("C2", axis=(0, 0, 1))
MISS_DEG = 3.0  # how far the path of tilts passes beside the exact top-down view

_COLOURS = ("#3b77c2", "#e0862e", "#4fa78a", "#b77bc9")
_AXES_COLOURS = ("#d0312d", "#2e9e3f", "#2f5fd0")
_STYLE: Any = {
    "svg.hashsalt": "synthetless",
    "svg.fonttype": "none",
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


def turn(axis: str, degrees: float | Floats) -> Floats:
    """Rotation matrices (..., 3, 3) about a coordinate axis."""
    vector = np.asarray(degrees)[..., None] * np.eye(3)["xyz".index(axis)]
    return np.asarray(Rotation.from_rotvec(vector, degrees=True).as_matrix())


def labels(R_m2c: Floats, scheme: Scheme) -> CanonicalPoses:
    """The labels of rotations (N, 3, 3) of a C2 part."""
    return CanonicalMap(C2, scheme)(R_m2c, np.zeros((len(R_m2c), 3)))


def apart_deg(R_a: Floats, R_b: Floats) -> Floats:
    """Rotation angles between matrices (..., 3, 3)."""
    return np.asarray(np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(R_a - R_b, axis=(-2, -1)) / np.sqrt(8), 0, 1))))


def tilts_through_top_down(s_deg: Floats) -> Floats:
    """Poses (N, 3, 3) of a path that tilts the part by 180 + s degrees, `MISS_DEG` beside the top-down view."""
    return turn("y", MISS_DEG) @ turn("x", 180 + s_deg)


def map_alone(R_m2c: Floats) -> Floats:
    """The paper's Map: of the members R S of each class (N, 3, 3), the one nearest to the identity."""
    members = R_m2c[:, None] @ C2.motions()[None, :, :3, :3]
    nearest = np.argmax(np.trace(members, axis1=2, axis2=3), axis=1)
    return np.asarray(members[np.arange(len(members)), nearest])


def smallest_margin_at_tilt(tilt_deg: Floats, scheme: Scheme) -> Floats:
    """The smallest margin (N,) over the rotations in the image plane, for each tilt (N,)."""
    in_plane = turn("z", np.linspace(0, 180, 721))
    return np.array([labels(in_plane @ turn("x", t), scheme).discontinuity_margin_deg.min() for t in tilt_deg])


def map_figure() -> bytes:
    """The angle of the label over the angle of the part: Map alone, and with two regressors."""
    angle = np.arange(0.125, 360, 0.25)  # never exactly on a jump, where rounding would decide
    R = turn("z", angle)
    both = labels(R, "pitteri2019")
    figure = Figure((7.2, 2.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    _line(left, angle, _angle_about_z_deg(map_alone(R)), np.zeros(len(angle), np.int64))
    left.set(title="Map alone", ylabel="angle of the label [°]")
    _line(right, angle, _angle_about_z_deg(both.R_m2c), both.regressor_index)
    right.set_title("Map′: two regressors")
    for axes in (left, right):
        axes.set(xlabel="angle of the part about its axis [°]", xticks=range(0, 361, 90), yticks=range(-90, 136, 45))
        axes.grid(alpha=0.3)
    right.set_ylim(-100, 190)
    _key(right, 2)
    return _svg(figure)


def jump_figure() -> bytes:
    """Labels along a path of tilts past the top-down view, and the smallest margin of each tilt."""
    s = np.linspace(-25, 25, 1001)
    R = tilts_through_top_down(s)
    figure = Figure((9.6, 2.9), layout="constrained")
    panels = figure.subplots(1, 3)
    for axes, scheme in zip(panels, SCHEMES, strict=False):
        found = labels(R, scheme)
        _line(axes, 180 + s, apart_deg(found.R_m2c, found.R_m2c[0]), found.regressor_index)
        axes.set(title=scheme, xlabel="tilt along the path [°]", ylim=(-6, 190), yticks=range(0, 181, 45))
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("label's distance from the first [°]")
    _key(panels[1], 4)
    tilt = np.linspace(0, 180, 91)
    for scheme, style in zip(SCHEMES, ("-", "--"), strict=True):
        margins = smallest_margin_at_tilt(tilt, scheme)
        panels[2].plot(tilt, margins, style, color="#333333", linewidth=1.6, label=scheme)
    panels[2].set(title="smallest margin", xlabel="tilt of the axis [°]", ylabel="degrees", xticks=range(0, 181, 45))
    panels[2].set_ylim(0, 50)
    panels[2].grid(alpha=0.3)
    panels[2].legend(loc="lower left")
    return _svg(figure)


def charts_figure() -> bytes:
    """Which regressor is responsible; dark where its label is the part turned by 180 degrees about its axis."""
    figure = Figure((8.2, 6.2), layout="constrained", facecolor="white")
    for scheme, (left, right) in zip(SCHEMES, figure.subplots(2, 2, width_ratios=(1.45, 1)), strict=True):
        in_plane, tilt = np.meshgrid(np.arange(360) + 0.5, np.arange(180)[::-1] + 0.5)
        R = turn("z", in_plane.ravel()) @ turn("x", tilt.ravel())
        left.imshow(_colours(R, scheme).reshape(*tilt.shape, 3), extent=(0, 360, 0, 180), interpolation="nearest")
        left.set(title=f"{scheme}: all tilts", ylabel="tilt of the axis [°]", aspect="auto")
        left.set(xlabel="rotation in the image [°]", xticks=range(0, 361, 90), yticks=range(0, 181, 45))
        right.imshow(_around_top_down(scheme), extent=(-90, 90, -90, 90), interpolation="nearest")
        for radius in (30, 60):
            circle = np.exp(1j * np.linspace(0, 2 * np.pi, 181)) * radius
            right.plot(circle.real, circle.imag, color="white", linewidth=0.6)
        right.set_title(f"{scheme}: around the top-down view")
        right.set_axis_off()
    return _png(figure, 100)


def _around_top_down(scheme: Scheme, side: int = 361) -> Floats:
    """A picture (side, side, 3): the top-down view in the middle, tilted from it by up to 90 degrees every way."""
    x, y = np.meshgrid(np.linspace(-90, 90, side), np.linspace(90, -90, side))
    inside = np.hypot(x, y) < 90
    axes = np.stack([-y[inside], x[inside], np.zeros(inside.sum())], axis=1)
    R = Rotation.from_rotvec(axes, degrees=True).as_matrix() @ turn("x", 180.0) @ turn("z", 20.0)
    picture = np.ones((side, side, 3))
    picture[inside] = _colours(R, scheme)
    return picture


def _colours(R_m2c: Floats, scheme: Scheme) -> Floats:
    """The colours (N, 3) of labels: the hue is the regressor's, dark where the label is another pose than its own."""
    found = labels(R_m2c, scheme)
    colours = np.array([to_rgb(colour) for colour in _COLOURS])[found.regressor_index]
    turned = apart_deg(found.R_m2c, R_m2c) > 90
    return np.where(turned[:, None], 0.55 * colours, 0.25 + 0.75 * colours)


def part_figure() -> bytes:
    """Built-in parts 27 (C4) and 26 (C2, axis beside the origin) in poses that look the same."""
    parts = load_models(ROOT / "assets" / "parts", (26, 27))
    figure = Figure((9.6, 2.5), layout="constrained", facecolor="white")
    panels = figure.subplots(1, 4)
    view = turn("x", 125.0) @ turn("z", 25.0)
    shown = [(27, 0, "part 27, C4: R"), (27, 1, "part 27: R S"), (26, 0, "part 26, C2: R"), (26, 1, "part 26: R S")]
    for axes, (obj_id, element, title) in zip(panels, shown, strict=True):
        _draw_part(axes, parts[obj_id], view, element)
        axes.set_title(title, fontsize=9)
    return _png(figure, 120)


def _draw_part(axes: Axes, part: ObjectModel, view: Floats, element: int) -> None:
    group = SymmetryGroup.from_bop(part.info)
    camera = Intrinsics(300, 270, 600.0, 600.0, 149.5, 150.0)
    motion = group.motions()[element]
    t_view = np.array([0.0, 0.0, 2.6 * part.diameter_mm])
    R, t = view @ motion[:3, :3], view @ motion[:3, 3] + t_view
    caster = scene_caster({"model": {part.obj_id: part}})
    seen = caster.annotate(camera, None, [PosedModel(part.obj_id, R, t)], normals=True)
    assert seen.normals is not None
    light = np.array([-0.35, -0.75, -0.56])
    shade = 0.42 + 0.5 * np.clip(seen.normals @ light, 0, 1)
    axes.imshow(np.where(seen.instance_ids == 0, shade, 1.0), cmap="gray", vmin=0, vmax=1)

    def project(points_mm: Floats) -> Floats:
        x, y, z = (points_mm @ R.T + t).T
        return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])

    length = 0.62 * part.diameter_mm
    ends = np.outer([-0.7, 1.1], length * np.array(group.axis)).astype(np.float64)
    axes.plot(*project(ends + np.array(group.offset_mm)), color="black", linewidth=1.2, dashes=(5, 3))
    for direction, colour, name in zip(0.75 * length * np.eye(3), _AXES_COLOURS, "xyz", strict=True):
        start, end = project(np.stack([np.zeros(3), direction])).T
        axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1.8})
        x, y = end + 0.12 * (end - start) + [8, 0]
        axes.text(x, y, name, color=colour, ha="center", va="center", fontsize=9)
    axes.set(xlim=(0, camera.width), ylim=(camera.height, 0))
    axes.set_axis_off()


def _angle_about_z_deg(R: Floats) -> Floats:
    return np.asarray(np.degrees(np.arctan2(R[:, 1, 0], R[:, 0, 0])))


def _line(axes: Axes, x: Floats, y: Floats, regressor: NDArray[np.int64]) -> None:
    """A line in its regressor's colour, broken where the regressor or the label changes."""
    breaks = np.flatnonzero((np.diff(regressor) != 0) | (np.abs(np.diff(y)) > 20)) + 1
    for piece in np.split(np.arange(len(x)), breaks):
        axes.plot(x[piece], y[piece], color=_COLOURS[regressor[piece[0]]], linewidth=2)


def _key(axes: Axes, n: int) -> None:
    for number in range(n):
        axes.plot([], [], color=_COLOURS[number], linewidth=2, label=f"regressor {number}")
    axes.legend(loc="upper right", fontsize=8, ncols=2)


def _svg(figure: Figure) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()


def _png(figure: Figure, dpi: int) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi, metadata={"Software": None})
    return file.getvalue()


FIGURES: dict[str, Callable[[], bytes]] = {
    "symmetry_map.svg": map_figure,
    "symmetry_jump.svg": jump_figure,
    "symmetry_charts.png": charts_figure,
    "symmetry_part.png": part_figure,
    "symmetry_notch.png": lambda: _png(notch.draw(), 120),
    "symmetry_hidden.png": lambda: _png(notch.draw_hidden(), 120),
}


def figures() -> Iterator[tuple[str, bytes]]:
    """Every figure's file name and content."""
    with rc_context(_STYLE):
        for name, make in FIGURES.items():
            yield name, make()


def main() -> None:
    """Write all figures."""
    for name, content in figures():
        (IMAGES / name).write_bytes(content)


if __name__ == "__main__":
    main()
