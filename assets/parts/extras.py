"""Parts with the symmetries that T-LESS lacks: D_2, D_4, C_3, D_6, O, O(2) and SO(3)."""

from math import cos, pi

from manifold3d import Manifold

from synthetless.assets.parts.features import (
    Profile,
    around,
    at,
    at_each,
    counterbore,
    disc,
    facing,
    gland_nut,
    hole,
    hull,
    lathe,
    plate,
    pocket,
    polygon,
    ring_groove,
    screw,
    tube,
    turned,
    union,
)


def _flipped(solid: Manifold) -> Manifold:
    """The solid and its copy turned over about x."""
    return solid + solid.rotate((180, 0, 0))


def _on_six_faces(solid: Manifold) -> Manifold:
    """The solid on +z, copied to the other faces of a cube."""
    turns = [(0, 0, 0), (180, 0, 0), (90, 0, 0), (-90, 0, 0), (0, 90, 0), (0, -90, 0)]
    return union(solid.rotate(turn) for turn in turns)


def _mirrored(profile: Profile) -> Profile:
    """The profile below the middle plane, in reverse."""
    return [(r, -z) for r, z in reversed(profile)]


def cable_joint_box() -> Manifold:
    """D_2: two equal half shells with a gland at both ends."""
    shell = hull(plate(74, 42, 12, 5), at(plate(68, 36, 1, 3), z=14)) + plate(66, 50, 5, 4)
    gland = at(facing(gland_nut(12, 18, 5.5), 0), 36, 0, 0)
    lug = at(plate(14, 12, 6, 3, 1), 24, 24, 1) - at(counterbore(2, 20, 3.6, 2), 25, 26, 7)
    ribs = at_each(plate(3, 34, 2.5, 0, 0.8), [(x, 0) for x in (-18, -12, 12, 18)], 14)
    panel = at(pocket(14, 24, 2, 2), z=15)
    clip = at(pocket(10, 4, 3, 1), -22, 24, 5)
    half = shell + around(lug, 2) + ribs - panel - around(clip, 2)
    return _flipped(half) + around(gland, 2)


def conduit_cross() -> Manifold:
    """D_4: four flanged sleeves on a hub with a round plate above and below."""
    hub = plate(46, 46, 16, 8, 2.5) + at(disc(19, 5, 1.5), z=14)
    sleeve = at(facing(disc(15, 32), 0), 20, 0, 0) + at(facing(disc(18.5, 8, 1.2), 0), 45, 0, 0)
    bore = at(facing(hole(11.5, 60), 0), 56, 0, 0)
    screws = at(screw(4.2, 3, 45), 15.5, 15.5, 15)
    recess = at(hole(11, 3), z=19) + at(hole(5, 10), z=16.5)
    web = hull(at(plate(18, 4, 6, 0, 1), 24, 0, 14), at(plate(4, 4, 2), 40, 0, 13))
    return _flipped(hub + around(web + screws, 4) - recess) + around(sleeve, 4) - around(bore, 4)


def three_way_box() -> Manifold:
    """C_3: a round box with three spouts, a lid above and feet below."""
    body = disc(29, 30, 1.5) - at(ring_groove(32, 27.6, 1.4), z=20)
    lid = at(lathe([(0, 0), (31, 0), (31, 5), (28, 8), (12, 9), (0, 9)]), z=29.5)
    spout = at(facing(tube(11, 7.5, 24, 1), 0), 24, 0, 13) + at(facing(tube(13.4, 7.5, 7, 1), 0), 44, 0, 13)
    foot = turned(hull(at(disc(6.5, 5, 1), 35, 0), at(disc(8, 5, 0), 24, 4)), 48)
    ear = turned(at(disc(5, 12, 1), 30, 0, 24), 75)
    holes = turned(at(counterbore(2.2, 9, 4, 2), 35, 0, 5), 48) + turned(at(hole(1.8, 9, 1.2), 30.5, 0, 36), 75)
    bore = at(facing(hole(7.5, 30), 0), 51, 0, 13)
    bottom = hole(17, 2.5) + ring_groove(24, 21, 1.5)
    body = body + lid + around(spout + foot + ear, 3) - around(bore + holes, 3)
    return body - at(hole(9, 2), z=38.5) - bottom.rotate((180, 0, 0))


def lock_nut() -> Manifold:
    """D_6: a hexagonal nut with both faces alike."""
    flats, top = 54.0, 14.0
    corner = flats / 2 / cos(pi / 6)
    rim = [(flats / 2 - 1, top), (corner + 0.5, top - 4)]
    crown = lathe([(0, top), *rim, *_mirrored(rim), (0, -top)])
    washer = tube(23, 18, 2 * top + 4, 1).translate((0, 0, -top - 2))
    notch = at(pocket(5, 12, 3, 1), 0, 22, top + 2)
    rings = [(15.0 + 1.6 * (k % 2), 1.7 * k) for k in range(7, 0, -1)]
    mouth = [(0, top + 3), (19.5, top + 3), (15.0, top - 1.5)]
    bore = lathe([*mouth, *rings, (15.0, 0), *_mirrored(rings), *_mirrored(mouth)])
    hexagon = polygon(6, flats).extrude(2 * top + 2).translate((0, 0, -top - 1))
    return (hexagon ^ turned(crown, 360 / 96 / 2)) + washer - bore - _flipped(around(notch, 6))


def cube_connector() -> Manifold:
    """O: a cube with the same port in all six faces."""
    size, chamfer = 60.0, 5.0
    inner = size - 2 * chamfer
    cube = hull(
        *(Manifold.cube(edges, True) for edges in ((size, inner, inner), (inner, size, inner), (inner, inner, size)))
    )
    port = at(tube(16, 12, 5, 1), z=size / 2 - 1)
    well = at(hole(12, 11), z=size / 2 + 4) + at(hole(5, 5), z=size / 2 - 7)
    seat = at(counterbore(2, 7, 4, 2), 19.5, 19.5, size / 2)
    groove = at(pocket(18, 3, 2, 1), 0, 21, size / 2)
    return cube + _on_six_faces(port) - _on_six_faces(well + around(seat + groove, 4))


def cartridge_fuse() -> Manifold:
    """O(2): a ceramic tube between two equal caps."""
    end = [(0, 38), (5, 38), (5, 36), (11, 36), (13, 37), (18, 37), (19.5, 35.5), (19.5, 27), (18.5, 26), (18.5, 24)]
    half = [*end, (16.5, 23), (16.5, 13), (15.3, 12), (15.3, 10), (16.5, 9)]
    return lathe([*half, *_mirrored(half)])


def ball_insulator() -> Manifold:
    """SO(3): a ball of 60 mm."""
    return Manifold.sphere(30.0, 112)
