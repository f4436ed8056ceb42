"""Where a group's standard frame goes in the model frame."""

from __future__ import annotations

import numpy as np

from synthetless.symmetry.point_groups import Z
from synthetless.symmetry.quaternions import Floats, from_matrix, minimal, normalise


def signed_axis(axis: Floats) -> Floats:
    """The axis or its opposite: the one whose last component that is not nearly zero is positive.

    Both describe the same group; one sign makes the labels independent of how somebody wrote it.
    """
    last = next((value for value in axis[::-1] if abs(value) > 1e-3), 1.0)
    return axis if last > 0 else -axis


def frame_of_axis(axis: Floats) -> Floats:
    """The smallest rotation (wxyz) that takes z to the axis, after its sign is settled."""
    return minimal(Z, signed_axis(axis))


def frame_of_axes(axis: Floats, secondary_axis: Floats) -> Floats:
    """The rotation (wxyz) that takes z to `axis` and x to the part of `secondary_axis` perpendicular to it."""
    x = normalise(secondary_axis - (secondary_axis @ axis) * axis)
    return np.asarray(from_matrix(np.stack([x, np.cross(axis, x), axis], axis=1)[None])[0])
