"""A made-up arm with six axes and a parallel gripper, to see that nothing in planner and verifier is the Panda's.

Shoulder, elbow and wrist of an ordinary industrial arm, with a reach of about 0.9 m; the fingers close along x of the tip
frame, and open to 0.1 m.  All shapes are boxes.
"""

from __future__ import annotations

from pathlib import Path

from magic_core.robot import RobotConfig

#: name, parent, origin of the joint in the parent, axis, limits (rad)
JOINTS = (
    ("turn", "foot", (0, 0, 0.2), (0, 0, 1), (-3.0, 3.0)),
    ("shoulder", "turn", (0, 0, 0.12), (0, 1, 0), (-1.9, 1.9)),
    ("elbow", "shoulder", (0, 0, 0.40), (0, 1, 0), (-2.6, 2.6)),
    ("forearm", "elbow", (0, 0, 0.18), (0, 0, 1), (-3.0, 3.0)),
    ("wrist", "forearm", (0, 0, 0.20), (0, 1, 0), (-2.2, 2.2)),
    ("flange", "wrist", (0, 0, 0.08), (0, 0, 1), (-3.1, 3.1)),
)
#: link, box (m), its middle in the link's frame, mass (kg)
BOXES = {
    "foot": ((0.16, 0.16, 0.18), (0, 0, 0.09), 8.0),
    "turn": ((0.10, 0.10, 0.10), (0, 0, 0.03), 4.0),
    "shoulder": ((0.08, 0.08, 0.32), (0, 0, 0.20), 5.0),
    "elbow": ((0.07, 0.07, 0.12), (0, 0, 0.08), 2.0),
    "forearm": ((0.06, 0.06, 0.12), (0, 0, 0.09), 1.5),
    "wrist": ((0.05, 0.05, 0.05), (0, 0, 0.03), 0.6),
    "flange": ((0.12, 0.06, 0.05), (0, 0, 0.045), 0.7),
}
HOME = (0.0, 0.5, 1.3, 0.0, 1.3, 0.0)


def _box(size: tuple[float, ...], middle: tuple[float, ...], mass: float) -> str:
    place = f'<origin xyz="{middle[0]} {middle[1]} {middle[2]}"/>'
    shape = f'<geometry><box size="{size[0]} {size[1]} {size[2]}"/></geometry>'
    inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    return f'<collision>{place}{shape}</collision><inertial>{place}<mass value="{mass}"/>{inertia}</inertial>'


def describe(folder: Path) -> RobotConfig:
    """Write URDF and SRDF into a folder; the configuration that a user would set by the parameters ``robot.*``."""
    links = [f'<link name="{name}">{_box(*box)}</link>' for name, box in BOXES.items()]
    joints = []
    for name, parent, at, axis, (low, high) in JOINTS:
        joints.append(
            f'<joint name="joint_{name}" type="revolute"><parent link="{parent}"/><child link="{name}"/>'
            f'<origin xyz="{at[0]} {at[1]} {at[2]}"/><axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
            f'<limit lower="{low}" upper="{high}" velocity="2.5" effort="150"/></joint>'
        )
    for side, sign in (("left", 1), ("right", -1)):
        # Closed, the pads meet at x = 0; each finger opens by 0.05 m.
        links.append(f'<link name="{side}_finger">{_box((0.012, 0.022, 0.06), (sign * 0.006, 0, 0.03), 0.05)}</link>')
        joints.append(
            f'<joint name="zz_{side}" type="prismatic"><parent link="flange"/><child link="{side}_finger"/>'
            f'<origin xyz="0 0 0.07"/><axis xyz="{sign} 0 0"/><limit lower="0" upper="0.05" velocity="0.2" effort="40"/></joint>'
        )
    links.append('<link name="tip"/>')
    joints.append('<joint name="tip_joint" type="fixed"><parent link="flange"/><child link="tip"/><origin xyz="0 0 0.12"/></joint>')
    urdf, srdf = folder / "six_axis.urdf", folder / "six_axis.srdf"
    urdf.write_text(f'<?xml version="1.0"?><robot name="six_axis">{"".join(links)}{"".join(joints)}</robot>')
    neighbours = [(parent, name) for name, parent, *_ in JOINTS]
    neighbours += [("flange", "left_finger"), ("flange", "right_finger"), ("left_finger", "right_finger"), ("forearm", "flange")]
    pairs = "".join(f'<disable_collisions link1="{a}" link2="{b}" reason="Adjacent"/>' for a, b in neighbours)
    srdf.write_text(f'<?xml version="1.0"?><robot name="six_axis">{pairs}</robot>')
    return RobotConfig(
        urdf=str(urdf), srdf=str(srdf), move_group="tip", closing_axis="x", opening=0.1, home=HOME, acceleration=(8.0,), velocity_scale=0.3
    )
