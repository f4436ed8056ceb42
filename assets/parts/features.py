"""The vocabulary of the parts: plates, turned bodies, holes, screws, pins, sockets, cable entries.

Lengths in mm. Solids stand on z = 0 around the z axis unless said otherwise. What is cut away ("hole", "well",
"groove") hangs from z = 0 downwards and reaches a little above it, so that no two faces coincide.
"""

from collections.abc import Iterable, Sequence
from math import cos, pi, sin

from manifold3d import CrossSection, FillRule, JoinType, Manifold, OpType

Profile = Sequence[tuple[float, float]]

OVERLAP = 0.5  # how far a tool reaches beyond the face that it cuts
EARTH_WIDTH = 5.0
PIN_SPACING = 19.0  # CEE 7
PIN_RADIUS = 2.4


def segments(radius: float) -> int:
    """Facets of a full circle; always a multiple of 12, so that circles share the symmetries of the parts."""
    return 24 if radius < 7 else 48 if radius < 20 else 96


def union(solids: Iterable[Manifold]) -> Manifold:
    return Manifold.batch_boolean(list(solids), OpType.Add)


def outline(points: Profile) -> CrossSection:
    """A polygon in either orientation, on a fixed fine grid so that it is the same on every machine."""
    return CrossSection([[(round(x, 12), round(y, 12)) for x, y in points]], FillRule.NonZero)


def rectangle(width: float, depth: float, radius: float = 0.0, facets: int = 24) -> CrossSection:
    """A centred rectangle with rounded corners."""
    inner = CrossSection.square((width - 2 * radius, depth - 2 * radius), True)
    return inner.offset(radius, JoinType.Round, 2.0, facets) if radius else inner


def polygon(corners: int, across_flats: float) -> CrossSection:
    """A regular polygon with a corner on the x axis."""
    radius = across_flats / 2 / cos(pi / corners)
    return outline([(radius * cos(2 * pi * k / corners), radius * sin(2 * pi * k / corners)) for k in range(corners)])


# --- bodies ---------------------------------------------------------------------------------------------------------


def lathe(profile: Profile, bevel: float = 0.0, facets: int = 96) -> Manifold:
    """The body of revolution of a closed (radius, z) outline, its convex corners bevelled."""
    half = outline(profile)
    if bevel:
        whole = half + half.mirror((1, 0))
        half = whole.offset(-bevel, JoinType.Miter, 4.0).offset(bevel, JoinType.Bevel)
    return half.revolve(facets)


def disc(radius: float, height: float, bevel: float = 0.0) -> Manifold:
    """A cylinder, both rims bevelled."""
    return lathe([(0, 0), (radius, 0), (radius, height), (0, height)], bevel, segments(radius))


def tube(outer: float, inner: float, height: float, bevel: float = 0.0) -> Manifold:
    return lathe([(inner, 0), (outer, 0), (outer, height), (inner, height)], bevel, segments(outer))


def prism(base: CrossSection, height: float, bevel: float = 0.0, foot_bevel: float = 0.0) -> Manifold:
    """A convex base extruded, with a bevelled top rim and foot."""
    if not bevel and not foot_bevel:
        return base.extrude(height)
    middle = base.extrude(height - bevel - foot_bevel).translate((0, 0, foot_bevel))
    top = base.offset(-bevel, JoinType.Miter, 4.0).extrude(height - foot_bevel).translate((0, 0, foot_bevel))
    foot = base.offset(-foot_bevel, JoinType.Miter, 4.0).extrude(height - bevel)
    return Manifold.batch_hull([middle, top if bevel else middle, foot if foot_bevel else middle])


def plate(width: float, depth: float, height: float, radius: float = 0.0, bevel: float = 0.0) -> Manifold:
    """A block with rounded upright edges, its top rim bevelled."""
    return prism(rectangle(width, depth, radius), height, bevel)


def hull(*solids: Manifold) -> Manifold:
    return Manifold.batch_hull(list(solids))


# --- placing --------------------------------------------------------------------------------------------------------


def at(solid: Manifold, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Manifold:
    return solid.translate((x, y, z))


def turned(solid: Manifold, degrees: float) -> Manifold:
    """Turned about z."""
    return solid.rotate((0, 0, degrees))


def facing(solid: Manifold, azimuth_deg: float, elevation_deg: float = 0.0) -> Manifold:
    """The solid's z axis laid into the direction of the azimuth; its y axis stays level, its x axis points down."""
    return solid.rotate((0, 90 - elevation_deg, azimuth_deg))


def around(solid: Manifold, count: int) -> Manifold:
    """`count` copies about z."""
    return union(turned(solid, 360 * k / count) for k in range(count))


def at_each(solid: Manifold, points: Iterable[tuple[float, float]], z: float = 0.0) -> Manifold:
    return union(at(solid, x, y, z) for x, y in points)


def corners(width: float, depth: float) -> list[tuple[float, float]]:
    return [(sx * width / 2, sy * depth / 2) for sx in (-1, 1) for sy in (-1, 1)]


# --- what is cut away -----------------------------------------------------------------------------------------------


def hole(radius: float, depth: float, countersink: float = 0.0) -> Manifold:
    """A round hole, its mouth widened by `countersink`."""
    wide = radius + countersink + OVERLAP if countersink else radius
    profile = [(0, -depth), (radius, -depth), (radius, -countersink), (wide, OVERLAP), (0, OVERLAP)]
    return lathe(profile, facets=segments(radius))


def counterbore(radius: float, depth: float, head_radius: float, head_depth: float) -> Manifold:
    """A screw hole with a sunk seat for the head."""
    return hole(radius, depth) + hole(head_radius, head_depth)


def pocket(width: float, depth: float, deep: float, radius: float = 0.0) -> Manifold:
    """A rectangular recess."""
    return at(rectangle(width, depth, radius, 12 if radius < 2 else 24).extrude(deep + OVERLAP), z=-deep)


def ring_groove(outer: float, inner: float, depth: float) -> Manifold:
    return at(tube(outer, inner, depth + OVERLAP), z=-depth)


def knockout(radius: float, depth: float = 1.0) -> Manifold:
    """The concentric grooves of a wall that is to be broken out for a cable."""
    return ring_groove(radius, radius * 0.8, depth) + ring_groove(radius * 0.55, radius * 0.35, depth)


# --- small parts ----------------------------------------------------------------------------------------------------


def screw(radius: float, height: float, slot_deg: float = 0.0) -> Manifold:
    """A cheese head with a slot."""
    head = disc(radius, height, min(0.6, height / 3))
    return head - turned(at(pocket(3 * radius, 0.4 * radius, 0.5 * height), z=height), slot_deg)


def pin(radius: float, length: float) -> Manifold:
    """A contact pin with a tapered tip."""
    tip = 0.8 * radius
    return lathe([(0, 0), (radius, 0), (radius, length - tip), (0.45 * radius, length), (0, length)], facets=24)


def cable_gland(radius: float, height: float, steps: int = 4) -> Manifold:
    """A stepped rubber cone that is cut open where the cable is as thick."""
    rise, shrink = height / steps, 0.66 * radius / (steps - 1)
    treads = [(radius - k * shrink, (k + end) * rise) for k in range(steps) for end in (0, 1)]
    return lathe([(0, 0), *treads, (0, height)], facets=48)


def gland_nut(radius: float, height: float, bore: float) -> Manifold:
    """A hexagonal cable gland with its cap and bore."""
    base = prism(polygon(6, 2 * radius), 0.45 * height, 0.6)
    inner = [(bore, 0.2 * height), (0.92 * radius, 0.2 * height), (0.92 * radius, 0.8 * height)]
    cap = lathe([*inner, (0.7 * radius, height), (bore, height)], facets=segments(radius))
    return base - at(hole(bore, height), z=0.45 * height) + cap


def thread(radius: float, depth: float, start: float, pitch: float, turns: int) -> list[tuple[float, float]]:
    """Points of rounded thread crests along +z (E14, E27): rings, so that the body stays one of revolution."""
    ring = [(-1.0, 0.0), (-0.25, 0.28), (0.0, 0.5), (-0.25, 0.72)]
    return [(radius + depth * r, start + pitch * (k + z)) for k in range(turns) for r, z in ring] + [
        (radius - depth, start + pitch * turns)
    ]


def lamp_holder(outer: float, bore: float, height: float, depth: float, facets: int = 96) -> Manifold:
    """A round holder with a conical mouth, an inner thread and a centre contact."""
    floor = height - depth
    inside = thread(bore + 1.4, 1.4, floor + 2, 3.6, max(2, int((depth - 9) / 3.6)))
    mouth = [(bore + 0.2, height - 4), (bore + 2.4, height)]
    wall = [(outer, 0), (outer, height - 1.2), (outer - 1.2, height)]
    contact = [(0, floor + 2.5), (3, floor + 2.5), (4, floor), (bore, floor)]
    return lathe([(0, 0), *wall, *reversed(mouth), *reversed(inside), *reversed(contact)], facets=facets)


def socket_well(depth: float = 16.0, radius: float = 19.5) -> Manifold:
    """What a CEE 7/3 socket cuts away: the well, the holes of the pins (along x) and of the earth clips (along y)."""
    well = hole(radius, depth, 0.8)
    holes = union(at(hole(PIN_RADIUS + 0.4, 6), x=x, z=-depth) for x in (-PIN_SPACING / 2, PIN_SPACING / 2))
    clips = union(at(pocket(EARTH_WIDTH, 5, depth - 2), y=y) for y in (-radius, radius))
    return well + holes + clips


def plug(radius: float, height: float, pin_length: float = 19.0) -> Manifold:
    """A CEE 7 plug: the insert with earth grooves (along y) and two pins (along x)."""
    insert = disc(radius, height, 1.0)
    grooves = union(at(pocket(EARTH_WIDTH + 1, 6, height - 2), y=y, z=height) for y in (-radius, radius))
    pins = union(at(pin(PIN_RADIUS, pin_length + 2), x=x, z=height - 2) for x in (-PIN_SPACING / 2, PIN_SPACING / 2))
    return insert - grooves + pins


def terminal(width: float = 9.0, depth: float = 10.0, height: float = 11.0) -> Manifold:
    """A screw terminal: a block with the wire's hole along y and a screw on top."""
    block = plate(width, depth, height, 0, 0.6)
    wire = at(facing(hole(2.2, depth + 1), 90), y=depth / 2, z=height * 0.4)
    return block - wire + at(screw(3.2, 2.4, 35), z=height - 0.2)
