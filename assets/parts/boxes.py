"""Parts on a block or in a box: lamp holders, outlets, junction boxes. Symmetric about z unless said otherwise."""

from manifold3d import Manifold

from synthetless.assets.parts.features import (
    Profile,
    around,
    at,
    at_each,
    cable_gland,
    counterbore,
    disc,
    facing,
    gland_nut,
    hole,
    hull,
    knockout,
    lamp_holder,
    lathe,
    plate,
    pocket,
    polygon,
    prism,
    ring_groove,
    screw,
    terminal,
    tube,
    turned,
    union,
)


def _half_turn(solid: Manifold) -> Manifold:
    return around(solid, 2)


def _from_below(tool: Manifold) -> Manifold:
    """A tool that hangs from z = 0, turned to cut upwards into the bottom."""
    return tool.rotate((180, 0, 0))


# --- lamp holders ---------------------------------------------------------------------------------------------------


def _with_lamp_holder(
    body: Manifold,
    outer: float,
    bore: float,
    height: float,
    depth: float,
    z: float,
    places: Profile = ((0, 0),),
) -> Manifold:
    """The body with lamp holders standing on z in it."""
    facets = 96 if len(places) == 1 else 60
    room = at_each(hole(outer - 0.5, height - 2), places, z + height)
    return body - room + at_each(lamp_holder(outer, bore, height, depth, facets), places, z)


def block_lamp_holder() -> Manifold:
    base = plate(95, 53.5, 13, 14) + at(plate(92.6, 51.1, 1.5, 13), z=12.5) + at(plate(95, 53.5, 13, 14, 2.5), z=13.6)
    shoulder = hull(at(plate(74, 50, 1, 14), z=26), at(disc(23, 1), z=42))
    seats = at_each(counterbore(2.6, 60, 5.2, 34), [(39, 15), (-39, -15)], 61)
    notch = at(pocket(16, 18, 34, 2), 22, -26.75, 25) + at(facing(hole(4.5, 12), 0), 47.5, -6, 7.3)
    body = base + shoulder - seats - _half_turn(notch) - _from_below(pocket(56, 26, 4, 4))
    return _with_lamp_holder(body, 22, 13.5, 24, 16, 35)


def ribbed_lamp_holder() -> Manifold:
    base = plate(89.4, 50, 18, 4, 1.5)
    core = hull(at(plate(60, 46, 1, 8), z=17), at(disc(23.5, 1, 0), z=40))
    ribs = at_each(plate(3, 50, 12, 0, 1), [(-26, 0), (26, 0)], 17)
    towers = _half_turn(at(plate(16, 21, 17, 2, 1), 35, 13, 17) + at(terminal(10, 14, 9), 35, -14, 17.5))
    seats = at(counterbore(2.4, 60, 4.6, 6), 35, 13, 34)
    slots = at(pocket(22, 5, 14, 1), 8, 25, 19) + at(pocket(6, 12, 8, 1), 44.7, 0, 19)
    bottom = _from_below(at(pocket(30, 18, 3, 2), 12, -10))
    body = base + core + ribs + towers - _half_turn(seats + slots + bottom)
    return _with_lamp_holder(body, 23.8, 14, 17.5, 15, 38)


def triple_lamp_holder() -> Manifold:
    row = [(50 * k, 0) for k in (-1, 0, 1)]
    board = plate(150, 89.4, 5, 5, 1.2) - at_each(_from_below(pocket(40, 76, 2.5, 4)), row)
    blocks = at_each(plate(46, 74, 28, 6, 2), row, 4.5) + at_each(hull(disc(22.5, 1), at(disc(20, 1), z=14)), row, 32)
    niches = at_each(pocket(34, 16, 22, 2), [(x, -37) for x, _ in row], 34)
    clamps = at_each(terminal(9, 14, 10), [(x + 11, -37) for x, _ in row], 11.5)
    screws = at(counterbore(2.2, 20, 4, 2), 71, 40.5, 5)
    body = board + (blocks - _half_turn(niches)) + _half_turn(clamps) - _half_turn(screws)
    return _with_lamp_holder(body, 20.5, 13.2, 21.5, 17, 40, row)


def quadruple_lamp_holder() -> Manifold:
    places = [(s * 46.5, t * 26.3) for s in (-1, 1) for t in (-1, 1)]
    board = plate(186, 105.4, 4, 6, 1) - at_each(_from_below(pocket(82, 42, 2, 6)), places)
    blocks = at_each(plate(88, 47, 24, 8, 2.5), places, 3.5)
    cones = at_each(hull(at(plate(56, 44, 1, 10)), at(disc(20, 1), z=14)), places, 27)
    seats = at_each(counterbore(2.4, 20, 5, 16), [(81, 38), (12, 14), (81, -14), (12, -38)], 28)
    mouths = union(at(facing(hole(5.5, 14), 90 * s), 46.5 + 18 * s, s * 49.9, 14.3) for s in (-1, 1))
    slots = at_each(pocket(18, 10, 13, 2), [(24, 49), (68, -49), (20, 4)], 28.5)
    body = board + (blocks + cones - _half_turn(seats + mouths + slots)) - _half_turn(at(hole(3, 9, 1.4), 88, 0, 4))
    return _with_lamp_holder(body, 20, 13.2, 22, 17, 38, places)


def footed_lamp_holder() -> Manifold:
    collar = at(lathe([(0, 0), (17.5, 0), (24.1, 8), (24.1, 12), (22, 16), (0, 16)]), z=36)
    tower = plate(40, 36, 38, 3, 1)
    foot = hull(at(plate(22, 15, 9, 4, 1), 22, -12), at(plate(10, 15, 14, 1), 12, -12))
    post = at(plate(12, 14, 28, 1, 1), 25, 9)
    cuts = (
        at(counterbore(2.2, 20, 4.2, 4), 28, -12, 9) + at(pocket(5, 20, 34, 1), 8, 18, 32) + at(hole(2.5, 9), 26, 9, 28)
    )
    body = tower + collar + _half_turn(foot + post) - _half_turn(cuts) - _from_below(pocket(18, 18, 6, 2))
    return _with_lamp_holder(body, 20.6, 13.2, 22, 18, 33.3)


def winged_lamp_holder() -> Manifold:
    collar = at(lathe([(0, 0), (18, 0), (26, 7), (26, 15), (23, 18), (0, 18)]), z=35)
    tower = prism(polygon(12, 46), 36, 1)
    wing = hull(at(disc(9.5, 8, 1), 29.6, -13), at(disc(9.5, 8, 1), 29.6, -3), at(plate(6, 26, 8), 14, -6))
    ear = at(plate(11, 18, 30, 2, 1), -24, -12)
    holes = at(counterbore(2.4, 20, 4.6, 3), 29.6, -13, 8) + at(hole(3.2, 20, 1), 29.6, 1, 8)
    body = tower + collar + _half_turn(wing + ear) - _half_turn(holes + at(pocket(7, 22, 26, 1), -4, 24, 30))
    return _with_lamp_holder(body - _from_below(pocket(20, 20, 8, 3)), 21, 13.4, 24, 19, 32.6)


# --- flush outlets --------------------------------------------------------------------------------------------------


def triple_outlet() -> Manifold:
    frame = at(plate(121.2, 78.5, 4, 4, 1.5), z=42) + at(plate(110, 62, 14, 6, 2), z=45)
    bucket = plate(104, 52, 43, 4)
    wells = [(35 * k, 0) for k in (-1, 0, 1)]
    rims = at_each(tube(17.2, 14.5, 5, 0.8), wells, 57.7)
    ribs = union(at(plate(6, 64, 26, 1, 1), 35 * k + 10, 0, 8) for k in (-1, 0, 1))
    lug = at(plate(12, 9, 5, 1), 0, 30, 38) + at(terminal(11, 12, 12), 38, 28, 14)
    body = frame + bucket + around(lug, 2) + _half_turn(ribs)
    holes = at_each(hole(14.5, 17) + at_each(hole(2.3, 26), [(-6.5, 0), (6.5, 0)]), wells, 59)
    screws = at_each(counterbore(1.8, 30, 3.6, 2), [(55, 34), (-55, -34)], 46)
    bottom = at(pocket(20, 30, 3, 2), 36, 4) + at(pocket(6, 18, 3, 1), 12, -12)
    return body + rims - holes - screws - _half_turn(_from_below(bottom))


def flush_lamp_holder() -> Manifold:
    flange = at(plate(80.6, 42, 3.6, 3, 1.2), z=37)
    bucket = plate(44, 38, 40, 3)
    neck = at(lathe([(0, 0), (20.6, 0), (19, 14), (0, 14)]), z=40)
    fin = hull(at(plate(3, 30, 1), 22, 4, 40), at(plate(3, 10, 1), 22, 8, 58))
    ear = hull(at(plate(3, 12, 2), 22.5, -7, 10), at(plate(2.5, 12, 2), 33, -7, 26)) + at(
        plate(12, 8, 10, 1, 0.8), 24, 10, 4
    )
    window = at(pocket(11, 26, 12, 1), 33, 0, 42)
    screws = at(_from_below(counterbore(1.8, 20, 4, 3)), 14, -11, 0)
    body = (
        flange
        + bucket
        + neck
        + _half_turn(fin + ear)
        - _half_turn(window + screws + at(pocket(8, 6, 18, 1), 12, 19, 20))
    )
    return _with_lamp_holder(body, 19, 13.2, 21.5, 18, 42)


# --- junction boxes -------------------------------------------------------------------------------------------------


def _lidded_box(width: float, depth: float, height: float, lid: float) -> Manifold:
    """A drawn box (its walls lean out from 8 mm to 4 mm inside the lid's rim), a shadow gap and an overhanging lid."""
    foot = hull(plate(width - 16, depth - 16, 1, 5), at(plate(width - 8, depth - 8, 1, 6), z=height - lid - 1))
    gap = at(plate(width - 11, depth - 11, lid, 6), z=height - lid - 1)
    return foot + gap + at(plate(width, depth, lid - 1.2, 7, 2), z=height - lid + 1.2)


def square_box() -> Manifold:
    body = _lidded_box(108.5, 108.5, 56, 17)
    entry = at(facing(cable_gland(13, 9), 0), 45, -17, 19) - at(facing(hole(3, 3), 0), 54, -17, 19)
    panel = at(facing(knockout(11, 4), 0), 50.5, 20, 19)
    lid = at(hole(5.2, 4), 46, 46, 56) + at(pocket(30, 3, 1.5), 0, 44, 56)
    bottom = _from_below(at(pocket(9, 18, 5, 2), 36, 30) + at(pocket(3, 34, 2), 28, 0))
    body = body - around(panel + lid + bottom, 4) - _from_below(ring_groove(18, 14, 2))
    return body + around(at(screw(4.6, 3, 25), 46, 46, 51.5) + entry, 4)


def square_box_with_glands() -> Manifold:
    body = _lidded_box(91, 91, 48.4, 12)
    single = at(facing(cable_gland(15.5, 11.75), 0), 38, 0, 17.5)
    double = at_each(facing(cable_gland(10.5, 11.75), 90), [(-20, 38), (20, 38)], 17.5)
    label = at(pocket(56, 14, 1.5, 3), 0, 24, 48.4)
    keys = at(pocket(30, 5, 4, 2), 22, 22) + at(hole(4, 4), 22, -26)
    body = body - around(at(hole(4.8, 4), 38, 38, 48.4), 4) - _half_turn(label + _from_below(keys))
    return body + _half_turn(single + double) + around(at(screw(4.2, 3, 65), 38, 38, 44), 4)


def oblong_box() -> Manifold:
    body = _lidded_box(113, 78, 56.8, 14)
    ends = at(facing(knockout(13, 4), 0), 53, 0, 21)
    sides = at(facing(cable_gland(12, 9), 90), -24, 30, 21) + at(facing(tube(9, 5, 7, 1), 90), 20, 30, 21)
    corners = [(49.5, 32), (49.5, -32)]
    label = at(plate(34, 12, 2, 3, 0.8), 22, 20, 55.6)
    floor = ring_groove(24, 21, 2) + ring_groove(15, 12, 2) + at(pocket(11, 11, 4, 2), 38, -20)
    body = body - _half_turn(ends + at_each(hole(5, 4), corners, 56.8) + _from_below(floor))
    return body + _half_turn(sides + label + at_each(screw(4.4, 3, 50), corners, 52.3))


# --- switches -------------------------------------------------------------------------------------------------------


def _switch_box() -> Manifold:
    foot = hull(plate(78, 57, 1, 5), at(plate(82, 61.5, 1, 5), z=21))
    box = foot + at(plate(79, 58, 3, 5), z=21) + at(plate(82, 61.5, 22, 7, 3), z=23.5)
    keyholes = at(hole(4.5, 4), -22, 14) + at(pocket(16, 4.4, 4, 2), -14, 14) + at(pocket(20, 3, 2, 1), 22, 18)
    return box - _from_below(pocket(66, 45, 2.5, 4)) - _half_turn(_from_below(at(keyholes, z=-2.5)))


def twin_rocker_switch() -> Manifold:
    rocker = hull(
        at(plate(26, 34, 1), 15, 0, 42), at(plate(3, 34, 1, 0), 26.5, 0, 59.8), at(plate(3, 34, 1), 3.5, 0, 47)
    )
    entry = at(facing(cable_gland(10, 9), 90), 18, 28, 12)
    seat = at(pocket(60, 38, 2.5, 3), z=45.5)
    return _switch_box() - seat - _half_turn(at(counterbore(2, 6, 3.6, 3), 34, -24, 45.5)) + _half_turn(rocker + entry)


def rotary_switch() -> Manifold:
    dial = at(disc(24, 4, 1), z=45)
    knob = at(disc(15, 9, 1), z=48) + at(plate(40, 9, 12, 4, 1.5), z=48.5)
    conduit = at(facing(gland_nut(11, 14, 5), 90), -20, 28.5, 12.3)
    cuts = at(counterbore(2, 6, 4, 3), 32, 22, 45.5) + at(pocket(3, 16, 2, 1), 30, -16, 45.5)
    return _switch_box() - _half_turn(cuts) + dial + turned(knob, 30) + _half_turn(conduit)
