"""A cylinder with notches along its whole height: as a mesh, and in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Notched:
    """About z; each notch is centred at an azimuth and as deep all over, its walls are radial, its floor is round."""

    radius_mm: float = 30.0
    height_mm: float = 40.0
    depth_mm: float = 3.0
    half_width_deg: float = 15.0
    azimuths_deg: tuple[float, ...] = (0.0,)

    def in_notch(self, x: Floats, y: Floats) -> NDArray[np.bool_]:
        azimuth = np.degrees(np.arctan2(y, x))[..., None]
        apart = np.abs((azimuth - np.array(self.azimuths_deg) + 180) % 360 - 180)
        return np.asarray((apart <= self.half_width_deg).any(axis=-1))

    def mesh(self, step_deg: float = 1.0) -> tuple[Floats, NDArray[np.int64]]:
        """A prism over the cross-section, finely divided; the ends are fans from the axis."""
        angles = np.radians(np.arange(0, 360, step_deg) + step_deg / 2)
        inside = self.in_notch(np.cos(angles), np.sin(angles))
        radii = np.where(inside, self.radius_mm - self.depth_mm, self.radius_mm)
        edges = np.radians(np.arange(0, 360, step_deg))
        before, after = np.roll(radii, 1), radii
        doubled = np.stack([before, after], axis=1).ravel()  # at each edge of a step, before and after it
        ring = np.stack([doubled * np.cos(np.repeat(edges, 2)), doubled * np.sin(np.repeat(edges, 2))], axis=1)
        n, half = len(ring), self.height_mm / 2
        vertices = np.concatenate(
            [
                np.column_stack([ring, np.full(n, -half)]),
                np.column_stack([ring, np.full(n, half)]),
                [[0, 0, -half], [0, 0, half]],
            ]
        )
        i, j = np.arange(n), (np.arange(n) + 1) % n
        sides = [np.stack([i, j, j + n], 1), np.stack([i, j + n, i + n], 1)]
        ends = [np.stack([j, i, np.full(n, 2 * n)], 1), np.stack([i + n, j + n, np.full(n, 2 * n + 1)], 1)]
        faces = np.concatenate([*sides, *ends])
        corners = vertices[faces]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        return vertices, faces[areas > 1e-9]

    def depth(self, R_m2c: Floats, t_m2c: Floats, directions: Floats) -> Floats:
        """z along rays (h, w, 3) with z = 1 from the camera, inf where they miss."""
        origin, d = -t_m2c @ R_m2c, directions @ R_m2c
        half, inner = self.height_mm / 2, self.radius_mm - self.depth_mm
        a, b = d[..., 0] ** 2 + d[..., 1] ** 2, d[..., 0] * origin[0] + d[..., 1] * origin[1]
        nearest = np.full(directions.shape[:2], np.inf)

        def offer(z: Floats, valid: NDArray[np.bool_]) -> None:
            better = valid & (z > 0) & (z < nearest)
            nearest[better] = z[better]

        with np.errstate(invalid="ignore", divide="ignore"):
            for radius, of_notch in ((self.radius_mm, False), (inner, True)):
                root = np.sqrt(b**2 - a * (origin[0] ** 2 + origin[1] ** 2 - radius**2))
                for sign in (-1, 1):
                    z = (-b + sign * root) / a
                    x, y, h = (origin[k] + z * d[..., k] for k in range(3))
                    offer(z, (np.abs(h) <= half) & (self.in_notch(x, y) == of_notch))
            for end in (-half, half):
                z = (end - origin[2]) / d[..., 2]
                x, y = (origin[k] + z * d[..., k] for k in range(2))
                offer(z, np.hypot(x, y) <= np.where(self.in_notch(x, y), inner, self.radius_mm))
            for azimuth in np.radians(self.azimuths_deg):
                for side in np.radians([-self.half_width_deg, self.half_width_deg]):
                    c, s = np.cos(azimuth + side), np.sin(azimuth + side)
                    z = -(origin[1] * c - origin[0] * s) / (d[..., 1] * c - d[..., 0] * s)
                    x, y, h = (origin[k] + z * d[..., k] for k in range(3))
                    along = x * c + y * s
                    offer(z, (np.abs(h) <= half) & (along >= inner) & (along <= self.radius_mm))
        return nearest
