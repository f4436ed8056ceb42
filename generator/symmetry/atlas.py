"""The anchors of both schemes: around which rotations the regressors' charts are centred.

Anchors are unit quaternions in the group's standard frame; the first is the identity. How the chart of a pose is
chosen is in `charts`.

`pitteri2019` is the scheme of Pitteri, Ramamonjisoa, Ilic, Lepetit, "On Object Symmetries and 6D Pose Estimation from
Images" (3DV 2019). Its rotations are those of R_m2c transposed, which reverses products.

* C_M: {1, u^(1/2)}, u the turn by a symmetry step about the axis, u^(1/2) by half of it.
* D_n: {1, v^(1/2), u^(1/2), v^(-1/2) u^(-1/2)}, index 2 (delta_1 - 1) + (delta_2 - 1), u about z of order n, v about x
  of order 2. The last is the paper's u^(1/2) v^(1/2), transposed; it belongs to another class of look-alikes.
* T, O, I, which the paper does not treat: {1, u^(1/2)} times {1, v^(1/2)}, u and v two rotations that generate the
  group, u of order 3, 4, 5 and a neighbouring v of order 2, 3, 3. Sound, but no better than the paper's scheme
  elsewhere: use `atlas`.
  The regressor is the one with the nearest anchor, all that look like it counted: for one axis that is the paper's rule
  (Map over the group of twice the order falls in the class of 1 or not).
* O(2): the limit n -> infinity of D_n, where u^(1/2) -> 1: {1, v^(1/2)}.
* Trivial group, SO(2), SO(3): one.

`atlas` has enough charts that some chart is far from its jumps at every pose; T, O and I by numerical optimisation.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from synthetless.symmetry.point_groups import FIVE_FOLD_AXIS, THREE_FOLD_AXIS, Family, GroupName, X, Z
from synthetless.symmetry.quaternions import IDENTITY, Floats, conjugate, from_axis_angle, multiply, normalise

Scheme = Literal["pitteri2019", "atlas"]

NO_JUMP_DEG = 180.0  # the margin of a label that never jumps: no two rotations are farther apart
SCHEMES: tuple[Scheme, ...] = ("pitteri2019", "atlas")


def anchors(name: GroupName, scheme: Scheme) -> Floats:
    """The anchors (n_regressors, 4) of a group in its standard frame, wxyz."""
    if scheme == "atlas":
        return _atlas(name)
    found = former_anchors(name)
    if name.family == "D":
        found[3] = conjugate(found[3])
    return found


def former_anchors(name: GroupName) -> Floats:
    """What version 0.1.0 had for `pitteri2019` before the fourth of D_n was transposed, for tables it wrote."""
    axes: dict[Family, list[tuple[Floats, int]]] = {
        "C": [(Z, name.n)] if name.n > 1 else [],
        "D": [(Z, name.n), (X, 2)],
        "T": [(THREE_FOLD_AXIS, 3), (Z, 2)],
        "O": [(Z, 4), (THREE_FOLD_AXIS, 3)],
        "I": [(FIVE_FOLD_AXIS, 5), (THREE_FOLD_AXIS, 3)],
        "O(2)": [(X, 2)],
    }
    return _half_steps(*axes.get(name.family, []))


def _half_steps(*axes: tuple[Floats, int]) -> Floats:
    """Products of {1, half a symmetry step} over the given (axis, order), the first axis counting slowest."""
    products = np.array([IDENTITY])
    for axis, order in axes:
        step = np.stack([np.array(IDENTITY), from_axis_angle(axis, np.pi / order)])
        products = multiply(products[:, None], step[None, :]).reshape(-1, 4)
    return products


def _atlas(name: GroupName) -> Floats:
    half_turn = from_axis_angle(X, np.pi)
    thirds = from_axis_angle(THREE_FOLD_AXIS, 2 * np.pi * np.arange(3) / 3)
    match name.family:
        case "C" if name.n > 1:
            flips = np.stack([np.array(IDENTITY), half_turn])
            return multiply(flips[:, None], _half_steps((Z, name.n))[None, :]).reshape(-1, 4)
        case "D":
            return multiply(thirds[:, None], _half_steps((Z, name.n))[None, :]).reshape(-1, 4)
        case "T" | "O" | "I":
            return normalise(_POLYHEDRAL[name.family])
        case "SO(2)":
            return np.stack([np.array(IDENTITY), half_turn])
        case "O(2)":
            return thirds
    return np.array([IDENTITY])


def smallest_margin_deg(name: GroupName, scheme: Scheme) -> float:
    """The smallest margin that any pose can have, degrees; 180 where labels never jump."""
    if name == ("C", 1) or name.family == "SO(3)":
        return NO_JUMP_DEG
    if scheme == "pitteri2019":
        if name.family == "D" and name.n % 2:
            c = float(np.cos(np.pi / (4 * name.n)))  # a formula that agrees with what a search found for n = 3 to 15
            return float(np.degrees(2 * np.arcsin((1 - c) * (3 + c) / 4)))
        return _SMALLEST_MARGIN_PITTERI2019_DEG.get(name.family, 0.0)
    if name.family == "C":
        return _between_half_steps_deg(name.n, tilt_rad=np.pi / 2)
    if name.family == "D":
        # No axis is farther than this from the nearest of three orthogonal lines. Attained where 3 divides n.
        bound_deg = _between_half_steps_deg(name.n, tilt_rad=np.arccos(1 / np.sqrt(3)))
        return _SMALLEST_MARGIN_DIHEDRAL_DEG.get(name.n, bound_deg)
    return _SMALLEST_MARGIN_ATLAS_DEG[name.family]


def _between_half_steps_deg(n: int, tilt_rad: float) -> float:
    """The margin half-way between the two charts of C_n, for an axis tilted from the reference by the given angle."""
    return float(np.degrees(2 * np.arcsin(np.cos(tilt_rad / 2) * np.sin(np.pi / (4 * n)))))


# T, O, I: lower bounds certified by branch and bound. D_4, D_5 and the paper's T: what a search found, rounded down.
_SMALLEST_MARGIN_ATLAS_DEG: dict[Family, float] = {
    "T": 18.744,
    "O": 18.988,
    "I": 12.884,
    "SO(2)": 90.0,
    "O(2)": 35.264389682754654,
}
_SMALLEST_MARGIN_DIHEDRAL_DEG = {2: 41.40962210927086, 4: 20.767, 5: 17.172}
_SMALLEST_MARGIN_PITTERI2019_DEG: dict[Family, float] = {"T": 6.87}

_POLYHEDRAL: dict[Family, list[tuple[float, float, float, float]]] = {
    "T": [
        (1.0, 0.0, 0.0, 0.0),
        (0.510973365694, -0.321217975825, -0.029683877291, -0.796771045525),
        (0.407052012811, 0.837999222319, -0.3545661159, -0.07967955644),
        (0.863206920471, 0.343839065124, -0.011409140466, 0.369483884979),
        (0.549347430842, 0.188205333491, -0.814116974064, -0.003115319152),
        (0.44450043038, 0.059333830894, 0.797317654956, 0.403959677442),
    ],
    "O": [
        (1.0, 0.0, 0.0, 0.0),
        (0.438590692759, -0.474146066022, 0.759446022801, -0.077881003795),
        (0.403252077586, 0.910077030849, -0.085531236679, -0.042801488241),
        (0.356315155937, 0.889626793867, -0.197659481783, -0.206238712527),
        (0.356026209403, -0.35158549006, -0.853135444764, -0.147624165655),
        (0.007182528111, -0.367230842664, 0.930101953692, 0.000524619249),
        (0.396758104174, -0.097866240339, 0.912025084372, 0.03486332241),
        (0.005856036894, 0.619684525482, -0.60144920237, 0.504198029228),
    ],
    "I": [
        (1.0, 0.0, 0.0, 0.0),
        (0.473135817056, -0.01506544786, 0.686889135752, -0.551451580907),
        (0.766762789954, -0.258670234255, 0.306854968671, -0.501003554933),
        (0.013065473777, 0.622940260757, -0.163582561015, -0.764863040456),
        (0.209758903806, 0.333797551626, -0.443488285216, 0.804921448142),
        (0.126264310678, 0.93812683313, -0.195441749479, -0.256472008945),
        (0.17782521475, 0.623667545719, -0.411959149143, -0.640083310869),
        (0.147341261507, 0.342266627787, -0.882542502823, 0.286814990669),
    ],
}
