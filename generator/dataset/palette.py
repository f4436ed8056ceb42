"""The colour of each class, the same in the contact sheet, in the preview and in the pictures of the docs.

32 colours of a grid over sRGB, chosen one after the other as the one farthest (CIE 1976) from those before it for the
worst of four eyes, normal ones and three colour-blind ones as simulated by Machado et al. 2009; then put into an order
in which neighbours differ most. ``tests/dataset/test_palette.py`` measures them.
"""

from __future__ import annotations

Color = tuple[int, int, int]

_HEX = (
    "eeaa00 00ccff cc0044 8822ff cceeaa 2266aa cc8800 00ffff ee2266 eeee00 aa00cc aaeecc cc6622 66aaff ffcc44 cc0066 "
    "8866ff aa8844 ff66cc 88ff88 66aa88 ee00cc ccaa44 aa4422 aa6688 8888ff aaaa66 eeaacc 44ff66 ff6688 aacc66 cc88aa"
)
PALETTE: tuple[Color, ...] = tuple((red, green, blue) for red, green, blue in map(bytes.fromhex, _HEX.split()))


def class_color(obj_id: int) -> Color:
    """The sRGB colour of an object id; ids that differ by a multiple of ``len(PALETTE)`` share one."""
    return PALETTE[(obj_id - 1) % len(PALETTE)]


def css_color(obj_id: int) -> str:
    """The same as CSS writes it: "#rrggbb"."""
    return "#{:02x}{:02x}{:02x}".format(*class_color(obj_id))
