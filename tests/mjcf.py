"""MuJoCo models (MJCF) of the bundled machines: an independent implementation.

Velocity-proportional terms (viscous friction, back-emf) are joint dampings, constant
gears are armatures. Two things that MJCF has no direct word for:

- the published Furuta model keeps the pendulum's own inertia out of the arm's equation:
  a point mass, and the hinge's armature for ``Jp`` (a true rod is a ``full_rod``);
- the rotor of the arm's second motor rides on link 1: joint armature alone misses the
  coupling, an explicit body on link 1 (or an armature of the tendon ``q1 - gr q2``)
  has it.
"""

from typing import Any

#: A body needs some inertia; 1e-12 of the smallest one in the models.
POINT = 2e-15

HEAD = """
<mujoco>
  <compiler angle="radian" autolimits="false" inertiafromgeom="false"/>
  <option gravity="0 0 {gravity}" integrator="Euler" timestep="0.001"/>
"""


def inertial(mass: float, place: tuple[Any, Any, Any], about: float | str) -> str:
    """An ``inertial`` element; one number is the inertia about every axis."""
    if not isinstance(about, str):
        about = f"{about!r} {about!r} {about!r}"
    x, y, z = place
    return f'<inertial mass="{mass!r}" pos="{x!r} {y!r} {z!r}" diaginertia="{about}"/>'


def furuta(
    p: dict[str, float], *, full_rod: bool = False, gravity: float = 9.81
) -> str:
    """Arm about the vertical, pendulum about the arm; a motor on the arm."""
    k, l = p["motor_constant"], p["pendulum_length"] / 2
    Jr = p["arm_mass"] * p["arm_length"] ** 2 / 12
    Jp = p["pendulum_mass"] * p["pendulum_length"] ** 2 / 12
    damping = p["arm_damping"] + k**2 / p["motor_resistance"]
    rod = f"{Jp!r} {Jp!r} {POINT!r}" if full_rod else POINT
    armature = 0.0 if full_rod else Jp
    return f"""{HEAD.format(gravity=-gravity)}
  <worldbody>
    <body name="arm">
      <joint name="theta" type="hinge" axis="0 0 1" damping="{damping!r}"/>
      {inertial(p["arm_mass"], (0, 0, 0), Jr)}
      <body name="pendulum" pos="{p["arm_length"]!r} 0 0">
        <joint name="alpha" type="hinge" axis="1 0 0"
               damping="{p["pendulum_damping"]!r}" armature="{armature!r}"/>
        {inertial(p["pendulum_mass"], (0, 0, -l), rod)}
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="voltage" joint="theta" gear="{k / p["motor_resistance"]!r}"/>
  </actuator>
</mujoco>
"""


def cartpole(p: dict[str, float], *, tilt: float = 0.0, extra: float = 0.0) -> str:
    """Cart on a rail along x, pole below it; ``extra`` moves the pole's centre."""
    Rm, Kg, Jm, r, efficiency = 2.6, 3.71, 3.9e-7, 6.35e-3, 0.9
    l, m, km = p["pole_half_length"], p["pole_mass"], p["motor_constant"]
    gain = efficiency * efficiency * Kg * km / (Rm * r)  # N per effective volt
    damping = p["cart_damping"] + gain * Kg * km / r
    armature = efficiency * Jm * (Kg / r) ** 2
    own = m * l**2 / 3
    return f"""{HEAD.format(gravity=-9.81)}
  <worldbody>
    <body name="rail" euler="0 {-tilt!r} 0">
      <body name="cart">
        <joint name="x" type="slide" axis="1 0 0"
               damping="{damping!r}" armature="{armature!r}"/>
        {inertial(p["cart_mass"], (0, 0, 0), 1e-3)}
        <body name="pole">
          <joint name="theta" type="hinge" axis="0 -1 0"
                 damping="{p["pole_damping"]!r}"/>
          {inertial(m, (0, 0, -(l + extra)), f"{own!r} {own!r} {POINT!r}")}
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="voltage" joint="x" gear="{efficiency * gain!r}"/>
  </actuator>
</mujoco>
"""


def two_link(
    p: dict[str, float],
    *,
    length1: float,
    gear: float,
    gravity: float,
    rotors: str = "tendon",
) -> str:
    """Two links in a vertical plane; the second rotor as a tendon's armature or a body.

    With ``rotors="bodies"`` the second rotor is a body of its own on link 1, with a
    joint ``rotor`` that the caller constrains to turn with ``-gear q2``.
    """
    r1 = 0.1  # any mass does: only first moment and inertia about the joint act
    m1 = p["m1r1"] / r1
    own1 = p["I1"] - m1 * r1**2
    r2 = p["m2r2"] / p["m2"]
    own2 = p["I2"] - p["m2"] * r2**2
    tendon = f"""
  <tendon>
    <fixed name="rotor2" armature="{p["Ir"]!r}">
      <joint joint="q1" coef="1"/>
      <joint joint="q2" coef="{-gear!r}"/>
    </fixed>
  </tendon>"""
    body = f"""
      <body name="rotor2">
        <joint name="rotor" type="hinge" axis="0 -1 0"/>
        {inertial(1e-9, (0, 0, 0), p["Ir"])}
      </body>"""
    armature = gear**2 * p["Ir"]
    return f"""{HEAD.format(gravity=-gravity)}
  <worldbody>
    <body name="link1">
      <joint name="q1" type="hinge" axis="0 -1 0" damping="{p["b1"]!r}"
             armature="{armature!r}"/>
      {inertial(m1, (0, 0, -r1), own1)}
      <body name="link2" pos="0 0 {-length1!r}">
        <joint name="q2" type="hinge" axis="0 -1 0" damping="{p["b2"]!r}"/>
        {inertial(p["m2"], (0, 0, -r2), own2)}
      </body>{body if rotors == "bodies" else ""}
    </body>
  </worldbody>{tendon if rotors == "tendon" else ""}
  <actuator>
    <motor name="torque1" joint="q1"/>
    <motor name="torque2" joint="q2"/>
  </actuator>
</mujoco>
"""
