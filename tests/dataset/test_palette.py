"""Classes are told apart by their colours, by the colour-blind, too."""

from __future__ import annotations

import numpy as np
import pytest

from synthetless.dataset.palette import PALETTE, class_color, css_color

# Machado, Oliveira and Fernandes 2009, severity 1, on linear RGB.
EYES = {
    "normal": np.eye(3),
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.119192, 0.9503041]]
)
WHITE = np.array([0.95047, 1.0, 1.08883])


def _lab(eye: str) -> np.ndarray:
    values = np.array(PALETTE) / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    xyz = np.clip(linear @ np.array(EYES[eye]).T, 0, 1) @ TO_XYZ.T / WHITE
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


@pytest.mark.parametrize("eye", EYES)
def test_colours_differ_and_neighbours_differ_much(eye: str) -> None:
    lab = _lab(eye)
    between = np.linalg.norm(lab[:, None] - lab[None], axis=-1)
    np.fill_diagonal(between, np.inf)
    assert between.min() > (12 if eye == "normal" else 8)
    assert min(between[i, (i + 1) % len(lab)] for i in range(len(lab))) > 17


def test_an_id_has_its_colour() -> None:
    assert css_color(1) == "#eeaa00"
    assert class_color(3) == (204, 0, 68)
    assert len({class_color(obj_id) for obj_id in range(1, 33)}) == 32
    assert class_color(33) == class_color(1)
