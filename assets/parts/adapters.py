"""Plugs and adapters: symmetric about y (19, 20, 23, modelled about z and laid over) or not at all (18, 21, 22)."""

from manifold3d import Manifold

from synthetless.assets.parts.features import (
    around,
    at,
    at_each,
    counterbore,
    disc,
    facing,
    hole,
    hull,
    lamp_holder,
    lathe,
    plate,
    plug,
    pocket,
    polygon,
    prism,
    ring_groove,
    screw,
    socket_well,
    terminal,
    tube,
    turned,
    union,
)


def _euro_socket(depth: float) -> Manifold:
    """The hexagonal well of a flat two-pin socket with its two contact holes (along y)."""
    well = prism(polygon(6, 12.4).scale((1, 2.1)), depth + 0.5)
    return at(well, z=-depth) + at_each(hole(2.4, 9), [(0, -9.5), (0, 9.5)], -depth)


def _flat_adapter(width: float, sockets: int) -> Manifold:
    """A row of flat sockets on top, a plug below; height about 76."""
    body = plate(width, 47, 20, 4, 0) + at(plate(width - 3, 44, 2, 3), z=19) + at(plate(width, 47, 15.4, 4, 2), z=20.6)
    body = at(body, z=40)
    stem = hull(at(plate(width - 26, 34, 1, 6), z=39.5), at(disc(17.5, 1), z=30))
    insert = at(plug(17.5, 14, 19), z=1).rotate((180, 0, 0))
    pitch = (width - 4) / sockets
    row = at_each(_euro_socket(8), [((k - (sockets - 1) / 2) * pitch, 0) for k in range(sockets)], 76.0)
    grips = at_each(pocket(3, 30, 14, 1), [(width / 2, 0), (-width / 2, 0)], 58)
    return body + stem + at(insert, z=33) - row - grips


def three_way_flat_adapter() -> Manifold:
    body = _flat_adapter(65.5, 3)
    screws = at_each(counterbore(2, 30, 3.8, 6).rotate((180, 0, 0)), [(26, 16), (-26, -16)], 40)
    return body - screws


def four_way_flat_adapter() -> Manifold:
    body = _flat_adapter(83, 4)
    ribs = at_each(plate(3, 40, 5, 1), [(x, 0) for x in (-36, -31, 31, 36)], 36)
    return body + ribs - around(at(pocket(22, 3, 12, 1), 12, 23.5, 58), 2)


def three_gang_socket_strip() -> Manifold:
    places = [(45 * k, 0) for k in (-1, 0, 1)]
    round_body = lathe([(0, 12), (15, 12), (22, 18), (24, 30), (24, 43), (22.5, 45), (0, 45)], facets=72)
    bridge = at(plate(92, 32, 24, 6, 2), z=15)
    neck = hull(at(plate(40, 30, 1, 8), z=14), at(disc(17.5, 1), z=4))
    insert = at(plug(17.5, 12, 19).rotate((180, 0, 0)), z=6)
    saddle = around(at(plate(14, 26, 8, 3, 1.5), 45, 0, 5) - at(hole(3, 5, 1).rotate((180, 0, 0)), 45, 0, 5), 2)
    wells = at_each(turned(socket_well(15, 19.5), 45), places, 45)
    cord = around(at(facing(tube(6.5, 3.4, 10, 1), 90), -22, 14, 27), 2)
    return at_each(round_body, places) + bridge + neck + turned(insert, 90) + saddle + cord - wells


# --- without symmetry -----------------------------------------------------------------------------------------------


def oblique_lamp_rose() -> Manifold:
    drum = disc(49.3, 64, 1.5) - at(disc(45.8, 60), z=6)
    oblique = drum.trim_by_plane((0.24, 0, -1), -51)
    hub = at(lathe([(0, 0), (27, 0), (24, 12), (0, 12)]), z=4)
    holder = at(lamp_holder(17, 13, 44, 34), z=10)
    ribs = union(turned(at(plate(30, 3, 16, 0, 1), 32, 0, 4), a) for a in (25, 110, 200, 290))
    ledge = turned(at(plate(20, 24, 12, 2, 1), 36, 0, 4) - at(counterbore(2, 9, 4, 3), 38, 0, 16), 155)
    entry = at(facing(hole(6, 12), 60), 25, 43, 17)
    under = at(pocket(40, 14, 4, 4).rotate((180, 0, 0)), 6, 22) + at(hole(9, 8).rotate((180, 0, 0)), -20, -14)
    feet = at_each(hole(2.6, 8, 1.5), [(38, -16), (-34, 22)], 6.2)
    return (
        oblique
        + (hub + ribs - at(disc(16, 60), z=10))
        + holder
        + at(turned(terminal(), 40), -22, -27, 5)
        + ledge
        - (entry + under + feet)
    )


def _barrel(length: float, belly: float, end: float) -> Manifold:
    """A barrel along x, its middle at the origin."""
    half = length / 2
    bulge = [(end + (belly - end) * (1 - (z / half) ** 2), z) for z in (half * k / 6 for k in range(-6, 7))]
    body = lathe([(0, -half), (end - 1.5, -half), *bulge, (end - 1.5, half), (0, half)], facets=96)
    return facing(body, 0)


def _adapter_core() -> Manifold:
    barrel = _barrel(76.9, 27, 23)
    neck = hull(at(facing(disc(20, 1), -90), 0, -15, 0), at(facing(disc(17.5, 1), -90), 0, -29, 0))
    insert = at(facing(plug(17.5, 10, 12), -90), 0, -25, 0)
    wells = at(facing(socket_well(15, 19), 0), 38.45, 0, 0) + at(
        facing(turned(socket_well(15, 19), 90), 180), -38.45, 0, 0
    )
    return barrel + neck + insert - wells


def two_way_adapter() -> Manifold:
    grips = union(at(facing(ring_groove(30, 25.8, 1.6), 0), x, 0, 0) for x in (-24, -20, 20, 24))
    screws = at_each(counterbore(2, 14, 3.6, 10), [(16, -10), (-12, 12)], 30)
    switch = at(hull(plate(20, 13, 1, 3), at(plate(17, 5, 1, 2), 0, 2.5, 9)), 2, 0, 25)
    label = at(facing(plate(12, 26, 8, 3, 1), 90), 3, 21, -6)
    return _adapter_core() - grips - screws + switch + label


def three_way_adapter() -> Manifold:
    third = hull(at(disc(22, 1), z=19.5), at(disc(21, 1), z=26)) + at(disc(21.6, 3, 0.8), z=25)
    well = at(turned(socket_well(10, 18.4), 45), z=28)
    spine = at(plate(34, 8, 14, 2, 1), 8, 25, -7) + at(facing(screw(4, 6, 20), 90), -20, 21, -8)
    return _adapter_core() + third + spine - well
