"""The scene in MJCF, of primitive shapes only: an arm with the kinematics of a Franka Emika Panda, a table, a bag."""

import math

import numpy as np

#: Denavit-Hartenberg parameters of the joints in Craig's convention: a (m), α (rad), d (m)
DH_PARAMETERS = (
    (0.0, 0.0, 0.333),
    (0.0, -math.pi / 2, 0.0),
    (0.0, math.pi / 2, 0.316),
    (0.0825, math.pi / 2, 0.0),
    (-0.0825, -math.pi / 2, 0.384),
    (0.0, math.pi / 2, 0.0),
    (0.088, math.pi / 2, 0.0),
)
#: From the last joint's frame to the flange, along its z axis, in m
FLANGE_OFFSET = 0.107
#: From the flange to the end effector, the point between the fingertips, in m
END_EFFECTOR_OFFSET = 0.1034
#: Lower and upper limits of the joints, in rad
JOINT_LIMITS = np.array(
    [
        (-2.8973, 2.8973),
        (-1.7628, 1.7628),
        (-2.8973, 2.8973),
        (-3.0718, -0.0698),
        (-2.8973, 2.8973),
        (-0.0175, 3.7525),
        (-2.8973, 2.8973),
    ]
).T
#: Half the sides of the bag, in m
BAG_HALF_SIZE = (0.05, 0.05, 0.02)

_SCENE = """
<mujoco model="visual_reacher">
  <compiler angle="radian"/>
  <statistic extent="1" center="0.4 0 0.3"/>
  <visual>
    <quality offsamples="0" shadowsize="1024" numslices="12" numstacks="4" numquads="1"/>
    <headlight ambient="0.45 0.45 0.45" diffuse="0.35 0.35 0.35" specular="0 0 0"/>
    <map znear="0.01" zfar="5"/>
  </visual>
  <default>
    <geom contype="0" conaffinity="0" rgba="0.92 0.92 0.9 1"/>
    <default class="dark"><geom rgba="0.2 0.2 0.22 1"/></default>
  </default>
  <worldbody>
    <light pos="0.5 -0.6 2" dir="0 0.3 -1" directional="true" diffuse="0.4 0.4 0.4" specular="0 0 0"/>
    <camera name="outside" pos="1.5 -1.2 1" xyaxes="0.737 0.676 0 -0.283 0.309 0.909" fovy="45"/>
    <geom name="floor" type="plane" pos="0 0 -0.6" size="3 3 0.1" rgba="0.36 0.37 0.4 1"/>
    <geom name="table" type="box" pos="0.4 0 -0.02" size="0.6 0.6 0.02" rgba="0.72 0.66 0.56 1"/>
    <geom name="leg" type="box" pos="0.4 0 -0.32" size="0.3 0.3 0.28" rgba="0.45 0.42 0.38 1"/>
    <body name="bag">
      <geom name="bag" type="box" size="{bag_size}" rgba="0.8 0.06 0.05 1"/>
    </body>
    <geom type="cylinder" fromto="0 0 0 0 0 0.28" size="0.06"/>
{arm}
  </worldbody>
</mujoco>
"""

# The camera's own axes: x to the right of the picture, y up, looking along −z. Up is the hand's x axis, which points
# away from the base, so the camera looks along the flange's axis.
_HAND = """
<body name="hand" pos="0 0 {flange}" euler="0 0 {mounting}">
  <geom class="dark" type="box" pos="0 0 0.03" size="0.025 0.1 0.03"/>
  <geom class="dark" type="box" pos="0 0.035 0.0875" size="0.024 0.01 0.0275"/>
  <geom class="dark" type="box" pos="0 -0.035 0.0875" size="0.024 0.01 0.0275"/>
  <geom class="dark" type="box" pos="0.055 0 0.015" size="0.03 0.02 0.014"/>
  <camera name="wrist" pos="0.07 0 0.03" xyaxes="0 1 0 1 0 0" fovy="60"/>
  <site name="flange" pos="0 0 0" size="0.005" group="5"/>
  <site name="end_effector" pos="0 0 {end_effector}" size="0.005" group="5"/>
</body>
"""


def scene_xml() -> str:
    """The whole scene as MJCF; the arm's frames follow from :data:`DH_PARAMETERS`."""
    arm = _HAND.format(flange=FLANGE_OFFSET, mounting=-math.pi / 4, end_effector=END_EFFECTOR_OFFSET)
    end = (0.0, 0.0, FLANGE_OFFSET)
    for i in reversed(range(len(DH_PARAMETERS))):
        a, alpha, d = DH_PARAMETERS[i]
        position = (a, -math.sin(alpha) * d, math.cos(alpha) * d)
        low, high = JOINT_LIMITS[:, i]
        # A casing around the joint's axis and a tube to the next frame, in the link's own frame.
        shape = '<geom type="cylinder" size="0.055 0.06"/>' if i < len(DH_PARAMETERS) - 1 else ""
        if math.hypot(*end) > 0:
            shape += f'<geom type="cylinder" fromto="0 0 0 {_numbers(end)}" size="0.045"/>'
        arm = (
            f'<body name="link{i + 1}" pos="{_numbers(position)}" euler="{alpha:.9g} 0 0">'
            f'<joint name="joint{i + 1}" axis="0 0 1" range="{low} {high}"/>'
            f'<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
            f"{shape}\n{arm}</body>"
        )
        end = position
    return _SCENE.format(arm=arm, bag_size=_numbers(BAG_HALF_SIZE))


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.9g}" for value in values)
