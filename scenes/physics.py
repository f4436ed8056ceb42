"""Objects fall onto the table, collide and come to rest: Blender's rigid bodies, judged on the true meshes.

Two acts. First the convex hulls fall between invisible frictionless walls that keep them together: a tube, or the sides
of the container, made thicker and higher. Then those walls are gone and the objects, now as tight-fitting convex
pieces, settle into what they touch; the container stays as it is. A throw counts only if the true meshes pass: at rest,
on the table, nothing floating, nothing inside something else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from synthetless.scenes.bullet import RigidWorld
from synthetless.scenes.collider import Collider, collider
from synthetless.scenes.contact import Contacts, Posed, Surface, measure
from synthetless.scenes.container import container_mesh, container_pieces, turn
from synthetless.scenes.rotations import matrix
from synthetless.scenes.spec import ContainerSpec, Pose

__all__ = ["Collider", "NotSettled", "PhysicsSettings", "Settled", "collider", "settle"]

Array = NDArray[np.float64]

_WALLS = 12
_THICKNESS_M = 0.5
_MM = 1000.0


@dataclass(frozen=True)
class PhysicsSettings:
    """How objects fall and when they count as at rest.

    Attributes:
        gravity_m_s2: downwards.
        friction: Coulomb's coefficient of every contact but those with the walls.
        restitution: 0 no bounce, 1 lossless bounce.
        linear_damping, angular_damping: share of the velocity lost per second; stands in for rolling friction.
        density_kg_m3: of every object.
        scale: metres are simulated as this many units.
        margin_m: Bullet's collision margin; objects rest about twice this apart.
        steps_per_second: of the simulation; a multiple of 24.
        iterations: of the contact solver, per step.
        fall_s: longest time between the walls.
        rest_s: longest time without them.
        still_m, still_s: at rest is when no point of any object moves further than this within this time. Bullet's
            friction lets piles creep by a few mm/s; what topples or rolls is faster.
        crowding: the walls' radius, in units of the root of the objects' summed squared radii.
        table_radius_m: objects must come to rest within this distance of the origin.
        max_gap_m: to what carries an object.
        max_penetration_m: into the table and each other.
    """

    gravity_m_s2: float = 9.81
    friction: float = 0.2
    restitution: float = 0.0
    linear_damping: float = 0.5
    angular_damping: float = 0.9
    density_kg_m3: float = 1000.0
    scale: float = 100.0
    margin_m: float = 0.0002
    steps_per_second: int = 240
    iterations: int = 50
    fall_s: float = 2.0
    rest_s: float = 4.0
    still_m: float = 0.004
    still_s: float = 0.5
    crowding: float = 0.7
    table_radius_m: float = 0.6
    max_gap_m: float = 0.001
    max_penetration_m: float = 0.001


class NotSettled(Exception):
    """The throw is no good; the message says which object and why. Throw again with other release poses."""


@dataclass(frozen=True)
class Settled:
    """Objects at rest, in the order they were given.

    Attributes:
        poses: model to world.
        gaps_m: distance of each true mesh to the nearest thing it touches: table, container or object.
        penetrations_m: how deep each true mesh and another thing are inside one another, at most.
    """

    poses: tuple[Pose, ...]
    gaps_m: tuple[float, ...]
    penetrations_m: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class _Bodies:
    """Rotations (n, 3, 3) and mass centres (n, 3), world."""

    rotations: Array
    centres_m: Array


def settle(
    colliders: Sequence[Collider],
    release: Sequence[Pose],
    settings: PhysicsSettings,
    container: ContainerSpec | None = None,
) -> Settled:
    """Let objects fall from their release poses until they rest.

    The result depends on the arguments alone, bit for bit. Blender's data is left as it was found.

    Args:
        colliders: one per object; an object drawn twice has the same one twice.
        release: where each is let go, model to world, above the table z = 0 and apart from each other; above a
            container they are moved inwards as far as needed to fall into it.
        settings: how they fall, and when they count as at rest.
        container: what they fall into.

    Raises:
        NotSettled: they do not come to rest, or not acceptably.
    """
    if not colliders:
        return Settled((), (), ())
    bodies = _released(colliders, release)
    if container is not None:
        bodies = _above(container, colliders, bodies)
    bodies, _ = _simulate(colliders, bodies, settings, container, walls=True)
    bodies, moved = _simulate(colliders, bodies, settings, container, walls=False)
    _check_place(bodies, settings)
    _check_stillness(moved, settings)
    placed = [
        Posed(item.surface, rotation, centre - rotation @ item.mass_centre_m)
        for item, rotation, centre in zip(colliders, bodies.rotations, bodies.centres_m, strict=True)
    ]
    n = len(placed)
    fixed = [] if container is None else [Posed(Surface(container_mesh(container)), np.eye(3), np.zeros(3))]
    contacts = measure([*placed, *fixed], 2 * settings.max_gap_m)
    names = [*(f"object {number}" for number in range(n)), *("the container" for _ in fixed), "the table"]
    _check_penetration(contacts, names, settings)
    _check_support(contacts, names, settings)
    return Settled(
        poses=tuple(_pose(item) for item in placed),
        gaps_m=tuple(contacts.gap_m[:n].min(axis=1).tolist()),
        penetrations_m=tuple(contacts.penetration_m[:n].max(axis=1).tolist()),
    )


def _released(colliders: Sequence[Collider], release: Sequence[Pose]) -> _Bodies:
    pairs = list(zip(colliders, release, strict=True))
    rotations = np.array([matrix(pose.rotation_wxyz) for pose in release]).reshape(-1, 3, 3)
    centres = [np.array(p.position_m) + R @ c.mass_centre_m for (c, p), R in zip(pairs, rotations, strict=True)]
    return _Bodies(rotations, np.array(centres).reshape(-1, 3))


def _above(container: ContainerSpec, colliders: Sequence[Collider], bodies: _Bodies) -> _Bodies:
    """Bodies moved along the table until each is between the sides of the floor.

    Raises:
        NotSettled: one is too large for that.
    """
    along = turn(container)
    half = np.array(container.floor_m) / 2
    centres = bodies.centres_m @ along
    for number, (item, rotation) in enumerate(zip(colliders, bodies.rotations, strict=True)):
        corners = (item.hull_m @ (along.T @ rotation).T)[:, :2]
        low, high = -half - corners.min(axis=0), half - corners.max(axis=0)
        if (low > high).any():
            raise NotSettled(f"object {number} does not fit into the container")
        centres[number, :2] = np.clip(centres[number, :2], low, high)
    return _Bodies(bodies.rotations, centres @ along.T)


def _pose(placed: Posed) -> Pose:
    x, y, z, w = Rotation.from_matrix(placed.rotation).as_quat(canonical=True).tolist()
    px, py, pz = placed.position_m.tolist()
    return Pose((w, x, y, z), (px, py, pz))


def _simulate(
    colliders: Sequence[Collider],
    start: _Bodies,
    settings: PhysicsSettings,
    container: ContainerSpec | None,
    walls: bool,
) -> tuple[_Bodies, Array]:
    """Run until still or out of time. Returns the bodies and how far each moved in the last moments, metres."""
    with RigidWorld(
        scale=settings.scale,
        gravity_m_s2=settings.gravity_m_s2,
        margin_m=settings.margin_m,
        friction=settings.friction,
        restitution=settings.restitution,
        linear_damping=settings.linear_damping,
        angular_damping=settings.angular_damping,
        steps_per_second=settings.steps_per_second,
        iterations=settings.iterations,
    ) as world:
        half = np.array([10 * settings.table_radius_m, 10 * settings.table_radius_m, _THICKNESS_M])
        world.add_fixed_box(half, np.eye(3), np.array([0, 0, -_THICKNESS_M]), settings.friction)
        if container is not None:
            _add_container(world, container, settings, (start.centres_m[:, 2].max() if walls else None))
        elif walls:
            _add_walls(world, colliders, start, settings)
        for item, rotation, centre in zip(colliders, start.rotations, start.centres_m, strict=True):
            mass = settings.density_kg_m3 * item.volume_m3
            world.add_body([item.hull_m] if walls else item.pieces_m, mass, rotation, centre)
        bodies, moved = start, np.zeros(len(colliders))
        for _ in range(math.ceil((settings.fall_s if walls else settings.rest_s) / settings.still_s)):
            before = bodies
            world.run(settings.still_s)
            bodies = _Bodies(*world.poses())
            moved = _moved(colliders, before, bodies)
            if (moved <= settings.still_m).all():
                break
        return bodies, moved


def _moved(colliders: Sequence[Collider], before: _Bodies, after: _Bodies) -> Array:
    turns = np.transpose(after.rotations - before.rotations, (0, 2, 1))
    shifts = after.centres_m - before.centres_m
    return np.array(
        [
            np.linalg.norm(item.hull_m @ turn + shift, axis=1).max()
            for item, turn, shift in zip(colliders, turns, shifts, strict=True)
        ]
    )


def _add_walls(world: RigidWorld, colliders: Sequence[Collider], start: _Bodies, settings: PhysicsSettings) -> None:
    """A tube about the z axis, as narrow as the objects and their release poses allow."""
    radii = np.array([item.radius_m for item in colliders])
    released_in = (np.linalg.norm(start.centres_m[:, :2], axis=1) + radii).max()
    radius = max(settings.crowding * math.sqrt((radii**2).sum()), released_in)
    height = (start.centres_m[:, 2] + radii).max()
    half = np.array([_THICKNESS_M, (radius + 2 * _THICKNESS_M) * math.tan(math.pi / _WALLS), height])
    for angle in np.arange(_WALLS) * (2 * math.pi / _WALLS):
        rotation = Rotation.from_rotvec([0, 0, angle]).as_matrix()
        world.add_fixed_box(half, rotation, rotation[:, 0] * (radius + _THICKNESS_M), friction=0.0)


def _add_container(
    world: RigidWorld, container: ContainerSpec, settings: PhysicsSettings, chute_m: float | None
) -> None:
    """The container itself; or, while objects fall into it, its floor between walls of the given height.

    What falls fast could pass through thin sides and floors: those walls are thick, and the floor is as thick as the
    table.
    """
    if chute_m is None:
        for piece in container_pieces(container):
            world.add_fixed_hull(piece, settings.friction)
        return
    along, half = turn(container), np.array(container.floor_m) / 2
    reach = half + 2 * _THICKNESS_M
    below = np.array([0, 0, container.wall_m - _THICKNESS_M])
    world.add_fixed_box(np.array([*reach, _THICKNESS_M]), along, below, settings.friction)
    for axis, side in ((0, -1), (0, 1), (1, -1), (1, 1)):
        size, centre = np.array([*reach, 2 * chute_m]), np.zeros(3)
        size[axis], centre[axis] = _THICKNESS_M, side * (half[axis] + _THICKNESS_M)
        world.add_fixed_box(size, along, along @ centre, friction=0.0)


def _check_place(bodies: _Bodies, settings: PhysicsSettings) -> None:
    for number, (x, y, z) in enumerate(bodies.centres_m.tolist()):
        if z < 0:
            raise NotSettled(f"object {number} fell through the table")
        if math.hypot(x, y) > settings.table_radius_m:
            raise NotSettled(f"object {number} left the table: it is {math.hypot(x, y):.2f} m from the middle")


def _check_stillness(moved: Array, settings: PhysicsSettings) -> None:
    if moved.max() > settings.still_m:
        raise NotSettled(
            f"object {moved.argmax()} still moves after {settings.fall_s + settings.rest_s:g} s, "
            f"{moved.max() * _MM:.1f} mm within {settings.still_s:g} s"
        )


def _check_penetration(contacts: Contacts, names: Sequence[str], settings: PhysicsSettings) -> None:
    i, j = np.unravel_index(contacts.penetration_m.argmax(), contacts.penetration_m.shape)
    depth = contacts.penetration_m[i, j]
    if depth > settings.max_penetration_m:
        first, second = sorted((int(i), int(j)))
        raise NotSettled(f"{names[first]} penetrates {names[second]} by {depth * _MM:.1f} mm")


def _check_support(contacts: Contacts, names: Sequence[str], settings: PhysicsSettings) -> None:
    """Everything must be connected to the table through contacts."""
    table = len(contacts.gap_m) - 1
    touches = contacts.gap_m <= settings.max_gap_m
    supported = np.zeros(table + 1, dtype=bool)
    supported[table] = True
    for _ in range(table):
        supported |= touches[supported].any(axis=0)
    if not supported.all():
        number = int(np.flatnonzero(~supported)[0])
        gap = contacts.gap_m[number].min()
        far = f"{gap * _MM:.1f} mm" if np.isfinite(gap) else f"more than {2 * settings.max_gap_m * _MM:.1f} mm"
        raise NotSettled(f"{names[number]} floats: {far} from what is nearest to it")
