"""The built-in parts: id, name, symmetry and the function that models each."""

from collections.abc import Callable
from dataclasses import dataclass

from manifold3d import Manifold

from synthetless.assets.parts import adapters, boxes, cylinders, extras


@dataclass(frozen=True)
class Part:
    """One part.

    `group` names its proper symmetry group (C1 none), about z through the origin of `solid()`, or about y after the
    part was laid over (`axis="y"`). Its origin lies in the centre of its bounding box, moved by `origin_x_mm` along x.
    """

    obj_id: int
    name: str
    group: str
    solid: Callable[[], Manifold]
    axis: str = "z"
    origin_x_mm: float = 0.0


PARTS = (
    Part(1, "fuse cap with a dished crown", "SO(2)", cylinders.dished_fuse_cap),
    Part(2, "fuse cap with a stepped collar", "SO(2)", cylinders.stepped_fuse_cap),
    Part(3, "fuse cap with a mushroom head", "SO(2)", cylinders.mushroom_fuse_cap),
    Part(4, "indicator lamp", "SO(2)", cylinders.indicator_lamp),
    Part(5, "lamp holder on a block", "C2", boxes.block_lamp_holder),
    Part(6, "lamp holder with terminal towers", "C2", boxes.ribbed_lamp_holder),
    Part(7, "triple lamp holder", "C2", boxes.triple_lamp_holder),
    Part(8, "quadruple lamp holder", "C2", boxes.quadruple_lamp_holder),
    Part(9, "triple flush outlet", "C2", boxes.triple_outlet),
    Part(10, "flush lamp holder", "C2", boxes.flush_lamp_holder),
    Part(11, "footed lamp holder", "C2", boxes.footed_lamp_holder),
    Part(12, "winged lamp holder", "C2", boxes.winged_lamp_holder),
    Part(13, "straight lamp socket", "SO(2)", cylinders.straight_lamp_socket),
    Part(14, "conical lamp socket", "SO(2)", cylinders.conical_lamp_socket),
    Part(15, "lamp socket with a base ring", "SO(2)", cylinders.lamp_socket_with_base_ring),
    Part(16, "porcelain lamp socket", "SO(2)", cylinders.porcelain_lamp_socket),
    Part(17, "ceiling rose with a lamp socket", "SO(2)", cylinders.ceiling_rose),
    Part(18, "oblique lamp rose", "C1", adapters.oblique_lamp_rose),
    Part(19, "three-way flat adapter", "C2", adapters.three_way_flat_adapter, axis="y"),
    Part(20, "four-way flat adapter", "C2", adapters.four_way_flat_adapter, axis="y"),
    Part(21, "two-way adapter", "C1", adapters.two_way_adapter),
    Part(22, "three-way adapter", "C1", adapters.three_way_adapter),
    Part(23, "three-gang socket strip with a plug", "C2", adapters.three_gang_socket_strip, axis="y"),
    Part(24, "screw-in socket adapter", "SO(2)", cylinders.screw_in_adapter),
    Part(25, "twin rocker switch", "C2", boxes.twin_rocker_switch, origin_x_mm=7.0),
    Part(26, "rotary switch", "C2", boxes.rotary_switch, origin_x_mm=7.0),
    Part(27, "square junction box", "C4", boxes.square_box),
    Part(28, "square junction box with cable glands", "C2", boxes.square_box_with_glands),
    Part(29, "oblong junction box", "C2", boxes.oblong_box),
    Part(30, "round junction box", "SO(2)", cylinders.round_junction_box),
    Part(31, "cable joint box", "D2", extras.cable_joint_box),
    Part(32, "conduit cross", "D4", extras.conduit_cross),
    Part(33, "three-way box", "C3", extras.three_way_box),
    Part(34, "lock nut", "D6", extras.lock_nut),
    Part(35, "cube connector", "O", extras.cube_connector),
    Part(36, "cartridge fuse", "O(2)", extras.cartridge_fuse),
    Part(37, "ball insulator", "SO(3)", extras.ball_insulator),
)
