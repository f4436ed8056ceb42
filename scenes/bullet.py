"""Blender's rigid body world (Bullet) in a temporary scene of its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typing_extensions import Self

from synthetless.scenes import blender

Array = NDArray[np.float64]

_FRAMES_PER_SECOND = 24
_LAST_FRAME = 100_000


class RigidWorld:
    """A simulation. As a context manager it leaves Blender's data as it found it.

    Lengths outside are metres; inside, everything is ``scale`` times as large, because Bullet's tolerances are made
    for bodies of about a metre.
    """

    def __init__(
        self,
        scale: float,
        gravity_m_s2: float,
        margin_m: float,
        friction: float,
        restitution: float,
        linear_damping: float,
        angular_damping: float,
        steps_per_second: int,
        iterations: int,
    ) -> None:
        bpy = self._bpy = blender.module()
        self._scale, self._margin = scale, margin_m * scale
        self._friction, self._restitution = math.sqrt(friction), restitution  # Bullet multiplies both bodies' values
        self._damping = linear_damping, angular_damping
        self._bodies: list[Any] = []
        self._frame = 0  # the first frame of all only sets the simulation up
        self._scene = bpy.data.scenes.new("physics")
        self._collection = bpy.data.collections.new("physics")
        self._blocks: list[Any] = [self._scene, self._collection]
        self._meshes: dict[int, tuple[Array, Any]] = {}
        self._scene.collection.children.link(self._collection)
        self._scene.render.fps, self._scene.render.fps_base = _FRAMES_PER_SECOND, 1.0
        self._scene.frame_start, self._scene.frame_end = 1, _LAST_FRAME
        self._scene.gravity = (0, 0, -gravity_m_s2 * scale)
        with bpy.context.temp_override(scene=self._scene):
            bpy.ops.rigidbody.world_add()
        world = self._scene.rigidbody_world
        world.collection = self._collection
        world.substeps_per_frame = round(steps_per_second / _FRAMES_PER_SECOND)
        world.solver_iterations = iterations
        world.use_split_impulse = True  # pushing apart what overlaps must not speed it up
        world.point_cache.frame_start, world.point_cache.frame_end = 1, _LAST_FRAME

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bpy.data.batch_remove(self._blocks)

    def add_fixed_box(self, half_size_m: Array, rotation: Array, centre_m: Array, friction: float) -> None:
        """A box that never moves."""
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
        box = self._add(signs * half_size_m, "BOX")
        box.rigid_body.type = "PASSIVE"
        box.rigid_body.friction = math.sqrt(friction)
        box.matrix_world = self._matrix(rotation, centre_m)

    def add_fixed_hull(self, corners_m: Array, friction: float) -> None:
        """A convex piece (n, 3), world frame, that never moves."""
        centre = corners_m.mean(axis=0)  # Bullet is most exact about a shape's own origin
        piece = self._add(corners_m - centre, "CONVEX_HULL")
        piece.rigid_body.type = "PASSIVE"
        piece.rigid_body.friction = math.sqrt(friction)
        piece.matrix_world = self._matrix(np.eye(3), centre)

    def add_body(self, pieces_m: Sequence[Array], mass_kg: float, rotation: Array, position_m: Array) -> None:
        """A body made of convex pieces, whose origin is its mass centre.

        Args:
            pieces_m: corners (n, 3) of each piece; bodies that share the arrays share their meshes.
            mass_kg: its mass.
            rotation: (3, 3) body to world.
            position_m: (3,) of its origin in the world.
        """
        if len(pieces_m) == 1:
            body = self._add(pieces_m[0], "CONVEX_HULL")
        else:
            body = self._add(pieces_m[0], "COMPOUND")
            for piece in pieces_m:
                self._add(piece, "CONVEX_HULL").parent = body
        body.rigid_body.mass = mass_kg
        body.matrix_world = self._matrix(rotation, position_m)
        self._bodies.append(body)

    def run(self, seconds: float) -> None:
        """Let time pass, in whole frames."""
        for _ in range(max(1, round(seconds * _FRAMES_PER_SECOND))):
            self._frame += 1
            self._scene.frame_set(self._frame)

    def poses(self) -> tuple[Array, Array]:
        """Rotations (n, 3, 3) and positions (n, 3) of the bodies, in the order they were added."""
        depsgraph = self._scene.view_layers[0].depsgraph
        matrices = np.array([body.evaluated_get(depsgraph).matrix_world for body in self._bodies], dtype=np.float64)
        matrices = matrices.reshape(-1, 4, 4)
        # The quaternions take the rounding of Blender's single precision out of the matrices.
        rotations = Rotation.from_matrix(matrices[:, :3, :3]).as_matrix() if len(matrices) else matrices[:, :3, :3]
        return rotations, matrices[:, :3, 3] / self._scale

    def _add(self, corners_m: Array, shape: str) -> Any:
        item = self._bpy.data.objects.new("physics", self._mesh(corners_m))
        self._blocks.append(item)
        self._collection.objects.link(item)  # makes it a rigid body
        body = item.rigid_body
        body.collision_shape = shape
        body.use_margin, body.collision_margin = True, self._margin
        body.friction, body.restitution = self._friction, self._restitution
        body.linear_damping, body.angular_damping = self._damping
        body.use_deactivation = False
        return item

    def _mesh(self, corners_m: Array) -> Any:
        _, mesh = self._meshes.get(id(corners_m), (None, None))
        if mesh is None:
            mesh = self._bpy.data.meshes.new("physics")
            mesh.from_pydata((corners_m * self._scale).tolist(), [], [])
            self._meshes[id(corners_m)] = corners_m, mesh  # the array is kept so that its id stays its own
            self._blocks.append(mesh)
        return mesh

    def _matrix(self, rotation: Array, position_m: Array) -> Any:
        from mathutils import Matrix

        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, position_m * self._scale
        return Matrix(matrix.tolist())
