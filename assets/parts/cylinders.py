"""Turned parts: generalised cylinders about z, every one a body of revolution with two different ends."""

from manifold3d import Manifold

from synthetless.assets.parts.features import Profile, lathe, thread


def _holder_inside(bore: float, rim: float, depth: float, contact: float = 4.0) -> Profile:
    """The inside of a lamp holder from the rim of its mouth down to the axis: cone, thread, floor, centre contact."""
    floor = rim - depth
    turns = int((depth - 10) / 3.6)
    inside = thread(bore + 1.4, 1.4, floor + 3, 3.6, turns)
    return [
        (bore + 2.6, rim),
        (bore + 0.4, rim - 5),
        *reversed(inside),
        (bore, floor),
        (contact + 1, floor),
        (contact, floor + 2.5),
        (0, floor + 2.5),
    ]


def dished_fuse_cap() -> Manifold:
    stem = [(0, 7), (2.6, 7), (2.6, 0), (5.2, 0), (6.2, 13), (9.5, 14.5)]
    crown = [(15, 31), (15, 45), (17.2, 47), (17.5, 54), (16.4, 59), (14, 61.2), (10.5, 61.2), (9.5, 54), (4, 54)]
    return lathe([*stem, *thread(12.6, 1.5, 15, 3.2, 4), (13.4, 28.5), (13.4, 31), *crown, (3.4, 50), (0, 50)])


def stepped_fuse_cap() -> Manifold:
    stem = [(0, 10), (3.6, 10), (4.4, 0), (6.8, 0), (8, 14), (11.6, 15)]
    body = [(15.8, 29), (15.8, 31), (18.6, 32.5), (18.6, 44), (17.4, 45), (17.4, 46.6), (21.6, 49), (21.6, 55.5)]
    top = [(18, 60.5), (14.5, 61.7), (12.8, 61.7), (11.4, 51.5), (5, 51.5), (5, 54.5), (0, 54.5)]
    return lathe([*stem, *thread(14.8, 1.6, 15, 3.4, 4), *body, *top])


def mushroom_fuse_cap() -> Manifold:
    stem = [(0, 6), (2.4, 6), (2.4, 0), (5, 0), (5.6, 9), (7.6, 9.6), (7.6, 15), (11.4, 15)]
    body = [(14, 27.5), (17.2, 28), (17.2, 43), (23.9, 44), (23.9, 49), (20, 54), (12.5, 60), (9, 61.7)]
    return lathe([*stem, *thread(14, 1.6, 15, 3.2, 4)[:-1], *body, (7, 61.7), (6, 57), (0, 57)])


def indicator_lamp() -> Manifold:
    foot = [(0, 0), (3, 0), (4.6, 1.2), (4.6, 4), (2.8, 5.5), (2.8, 9), (7, 11), (8.5, 15), (10.5, 16)]
    neck = [(13.4, 29.5), (15.6, 29.5), (15.6, 36), (14, 36), (14, 38.5), (20, 38.5)]
    lens = [(20, 66), (18, 68), (16, 68), (15.4, 71), (11, 75.8), (5, 78), (0, 78)]
    return lathe([*foot, *thread(13, 1.7, 17, 3.1, 4), *neck, *lens])


def straight_lamp_socket() -> Manifold:
    foot = [(0, 4), (4.5, 4), (4.5, 0.8), (9, 0.8), (9, 5), (12, 5), (12, 0), (16.6, 0), (17.4, 0.8)]
    wall = [(17.4, 15), (16.6, 15.6), (16.6, 17.4), (17.4, 18), (17.4, 31), (20, 33), (20, 45), (19, 46)]
    return lathe([*foot, *wall, *_holder_inside(13, 46, 34)])


def conical_lamp_socket() -> Manifold:
    foot = [(0, 8), (3, 8), (3, 3.5), (8, 3.5), (8, 6), (10.5, 6), (10.5, 0), (14.4, 0), (15.6, 1.4)]
    wall = [(15.6, 27), (14.7, 28), (14.7, 31), (15.8, 32), (22, 60), (22, 64), (21, 65.1)]
    return lathe([*foot, *wall, *_holder_inside(13.2, 65.1, 44)])


def lamp_socket_with_base_ring() -> Manifold:
    foot = [(0, 2), (4, 2), (4, 5), (8, 5), (8, 0), (11, 0), (11, 3), (14, 3), (14, 0), (20.5, 0), (22.25, 2)]
    wall = [
        (22.25, 19),
        (21.2, 20.6),
        (18.6, 20.6),
        (18.6, 17),
        (17, 17),
        (16.4, 24),
        (20.2, 50),
        (20.2, 54),
        (19.2, 55),
    ]
    return lathe([*foot, *wall, *_holder_inside(13, 55, 36)])


def porcelain_lamp_socket() -> Manifold:
    foot = [(0, 3), (5, 3), (5, 8), (10, 8), (10, 1.5), (13, 1.5), (13, 7), (22, 7), (22, 0), (25.2, 0), (27.2, 2)]
    wall = [(27.6, 17), (26.6, 18), (23.6, 18), (23.6, 21.4), (26.6, 21.4), (27.2, 22.4), (22.6, 45), (20.6, 47)]
    return lathe([*foot, *wall, *_holder_inside(14, 47, 33)])


def ceiling_rose() -> Manifold:
    hub = [(0, 6), (8, 6), (8, 3), (14, 3), (14, 8), (22, 8), (22, 5), (40, 5), (40, 2), (49, 2), (49, 0)]
    wall = [(52.4, 0), (53.9, 1.6), (50, 42), (48.4, 44), (45.6, 44), (44.6, 42), (46.6, 13), (28, 13), (23, 16)]
    holder = [(19, 20), (17.5, 22), (17.5, 50), (21, 52), (21, 59), (20, 60.1)]
    return lathe([*hub, *wall, *holder, *_holder_inside(13.4, 60.1, 36)], facets=120)


def screw_in_adapter() -> Manifold:
    foot = [(0, 80.6), (3.2, 80.6), (4.6, 79), (4.6, 76.6), (8, 74.5), (12, 73.5)]
    shoulder = [(12.4, 52), (18.6, 50), (20.2, 46), (20.2, 30), (19.4, 29), (19.4, 27), (20.2, 26), (21.5, 2), (20, 0)]
    well = [(17.6, 0), (16.4, 1.4), (16.4, 17), (11, 17), (11, 15), (6.5, 15), (6.5, 17), (3, 17), (3, 13.5), (0, 13.5)]
    return lathe([*foot, *reversed(thread(13.2, 1.6, 54, 3.6, 5)), *shoulder, *well])


def round_junction_box() -> Manifold:
    foot = [(0, 3), (6, 3), (6, 1.4), (9, 1.4), (9, 3), (17, 3), (17, 0.8), (22, 0.8), (22, 2.4), (29, 2.4), (29, 0)]
    wall = [(33.5, 0), (35.6, 2.2), (36, 15), (34.6, 16), (34.6, 18.5), (36, 19.5), (36.4, 37), (37.4, 38), (37.4, 40)]
    lid = [(40, 40), (40, 45.4), (38.2, 47.8), (32, 49.8), (22, 50.6), (21, 49.6), (0, 49.6)]
    return lathe([*foot, *wall, *lid], facets=120)
