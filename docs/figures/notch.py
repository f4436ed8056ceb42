"""The figures of docs/symmetry.md about a cylinder with a notch: what its images leave open."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from synthetless.annotation.instances import PosedModel
from synthetless.annotation.raycast import RayCaster
from synthetless.preview.statistics import SECTORS, cell_centres, cell_outlines
from synthetless.scenes.spec import Intrinsics
from synthetless.symmetry import CanonicalMap, SymmetryGroup
from synthetless.symmetry.ambiguity import Ambiguity, Cosets, see

Floats = NDArray[np.float64]

RADIUS_MM, HEIGHT_MM, DEPTH_MM, HALF_WIDTH_DEG = 30.0, 40.0, 4.0, 20.0
QUASI = SymmetryGroup("SO(2)")
CAMERA = Intrinsics(130, 120, 500.0, 500.0, 64.5, 59.5)
DISTANCE_MM = 350.0
SHOWN = (0, 75, 180)
HIDING = ((4, 0), (3, 2), (6, 14))
"""Band and sector of views that are shown: from behind, from beside, and from behind and above."""
ELEVATIONS = ((10, "-"), (60, "--"))
_STEP_DEG = 2


def mesh() -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3) and faces (F, 3) of a cylinder about z with a notch along its side, towards x."""
    azimuth = np.repeat(np.arange(0, 360, _STEP_DEG), 2)  # twice, as the radius before it and behind it may differ
    beside = azimuth + np.tile([-1, 1], len(azimuth) // 2)
    in_notch = np.abs((beside + 180) % 360 - 180) <= HALF_WIDTH_DEG
    radius, angle = np.where(in_notch, RADIUS_MM - DEPTH_MM, RADIUS_MM), np.radians(azimuth)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    n, z = len(ring), np.repeat([-HEIGHT_MM / 2, HEIGHT_MM / 2], len(ring))
    vertices = np.column_stack([np.tile(ring, (2, 1)), z])
    ends = np.array([[0, 0, -HEIGHT_MM / 2], [0, 0, HEIGHT_MM / 2]])
    i, j = np.arange(n), (np.arange(n) + 1) % n
    bottom, top = np.full(n, 2 * n), np.full(n, 2 * n + 1)
    faces = [(i, j, j + n), (i, j + n, i + n), (j, i, bottom), (i + n, j + n, top)]
    return np.concatenate([vertices, ends]), np.concatenate([np.stack(face, axis=1) for face in faces])


def pose(azimuth_deg: float, elevation_deg: float) -> PosedModel:
    """Upright, seen from above, the notch turned so far away from the camera."""
    upright = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    tilt = Rotation.from_rotvec([elevation_deg, 0, 0], degrees=True).as_matrix()
    turn = Rotation.from_rotvec([0, 0, azimuth_deg], degrees=True).as_matrix()
    return PosedModel(1, tilt @ upright @ turn, np.array([0.0, 0.0, DISTANCE_MM]))


def judged(caster: RayCaster, posed: PosedModel) -> Ambiguity:
    """What the image of a pose leaves open among 24 turns."""
    R_canonical = CanonicalMap(QUASI)(posed.R_m2c[None], posed.t_m2c[None]).R_m2c[0]
    return see(caster, CAMERA, posed, R_canonical, Cosets.of(QUASI, SymmetryGroup.trivial()))


def seen_from(direction: Floats) -> PosedModel:
    """Upright in the image, the camera in a direction (3,) of the model frame."""
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    R_m2c = np.stack([right, np.cross(-direction, right), -direction])
    return PosedModel(1, R_m2c, np.array([0.0, 0.0, DISTANCE_MM]))


def draw_hidden() -> Figure:
    """The viewing sphere by how many turns the view leaves open, and three views of it."""
    caster = RayCaster({("model", 1): mesh()})
    directions = cell_centres()
    open_turns = np.array([len(judged(caster, seen_from(each)).alike) for each in directions.reshape(-1, 3)])
    figure = Figure((9.6, 2.6), layout="constrained", facecolor="white")
    globe, *panels = figure.subplots(1, 1 + len(HIDING), width_ratios=[2.1, *[1] * len(HIDING)])
    cells = PolyCollection(list(cell_outlines().reshape(len(open_turns), -1, 2)), cmap="viridis_r", edgecolors="face")
    cells.set_array(open_turns)
    cells.set_clim(1, 12)
    globe.add_collection(cells)
    globe.set(xlim=(-2.9, 2.9), ylim=(-1.47, 1.47), aspect="equal")
    globe.set_axis_off()
    figure.colorbar(cells, ax=globe, shrink=0.8, ticks=[1, 4, 8, 12], label="turns left open, of 24")
    middles = cell_outlines().mean(axis=2)
    for number, (axes, (band, sector)) in enumerate(zip(panels, HIDING, strict=True), start=1):
        x, y = middles[band, sector]
        ink = "white" if open_turns[band * SECTORS + sector] > 4 else "black"
        globe.text(x, y, str(number), color=ink, ha="center", va="center", fontsize=9, fontweight="bold")
        picture(axes, caster, seen_from(directions[band, sector]))
        axes.set_title(f"{number}: {open_turns[band * SECTORS + sector]} of 24 open", fontsize=8)
    return figure


def picture(axes: Axes, caster: RayCaster, posed: PosedModel) -> None:
    """Shaded by the direction of the surface."""
    seen = caster.annotate(CAMERA, None, [posed], normals=True)
    assert seen.normals is not None
    shade = 0.42 + 0.5 * np.clip(seen.normals @ np.array([-0.35, -0.75, -0.56]), 0, 1)
    axes.imshow(np.where(seen.instance_ids == 0, shade, 1.0), cmap="gray", vmin=0, vmax=1)
    axes.set_axis_off()


def draw() -> Figure:
    """Three views with their view ambiguity, and the view ambiguity over the turn of the part."""
    caster = RayCaster({("model", 1): mesh()})
    figure = Figure((9.6, 2.6), layout="constrained", facecolor="white")
    panels = figure.subplots(1, len(SHOWN) + 1, width_ratios=[1] * len(SHOWN) + [1.9])
    for axes, azimuth in zip(panels, SHOWN, strict=False):
        posed = pose(azimuth, ELEVATIONS[0][0])
        picture(axes, caster, posed)
        open_turns = len(judged(caster, posed).alike)
        axes.set_title(f"turned by {azimuth}°: {open_turns} of 24 open", fontsize=8)
    turns = np.arange(0, 361, 10)
    for elevation, style in ELEVATIONS:
        shares = [judged(caster, pose(float(turn), elevation)).view_ambiguity for turn in turns]
        panels[-1].plot(turns, shares, style, color="#333333", label=f"seen from {elevation}° above")
    panels[-1].set(xlabel="turn of the part [°]", ylabel="view ambiguity", xticks=range(0, 361, 90), ylim=(0, 0.5))
    panels[-1].grid(alpha=0.3)
    panels[-1].legend(loc="upper right", fontsize=8)
    return figure
