"""A MuJoCo model with most of what a machine has, and where it is written."""

from pathlib import Path

#: A foot that slides and bounces, a limit, dry friction, a servo, and a motor with lag.
CRAWLER = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction=".6"/>
    <body name="torso" pos="0 0 .12">
      <joint name="x" type="slide" axis="1 0 0" damping=".05" frictionloss=".02"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="trunk" type="box" size=".1 .05 .03" mass="{trunk}" pos="0 0 .1"/>
      <body name="leg" pos="0 0 .08">
        <joint name="hip" axis="0 1 0" armature="{armature}" range="-.9 .9"
               damping=".02"/>
        <geom type="capsule" fromto="0 0 0 .05 0 -.08" size=".015" mass="{leg}"/>
        <body name="shin" pos=".05 0 -.08">
          <joint name="knee" axis="0 1 0" stiffness="1.5" frictionloss="{dry}"/>
          <geom name="foot" type="sphere" size=".03" pos="0 0 -.07" mass=".1"
                friction="{slip}"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="hip" kp="{kp}" kv=".2" ctrlrange="-1 1"/>
    <general name="motor" joint="knee" gear="3" gainprm="{gain}" dyntype="filter"
             dynprm=".03" biastype="none"/>
  </actuator>
</mujoco>
"""
USUAL = {
    "trunk": 0.8,
    "leg": 0.2,
    "armature": 0.01,
    "dry": 0.05,
    "slip": 0.7,
    "kp": 8.0,
    "gain": 0.4,
}
#: An arm of one joint, in the other format.
URDF = """
<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 -.2"/><mass value="1"/>
    <inertia ixx=".02" iyy=".02" izz=".001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><dynamics damping=".1" friction=".05"/></joint>
</robot>
"""


def written(tmp_path: Path, text: str) -> Path:
    """A model as a file."""
    path = tmp_path / "model.xml"
    path.write_text(text)
    return path
