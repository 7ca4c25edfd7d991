"""Mutants of effects on plants without a mass matrix, and of what may be added."""

from mutant_list import Hunt, Mutant

FRICTION, LAWS = "systems/effects/friction.py", "systems/effects/friction_laws.py"
KICKS, LIST = "systems/effects/kicks.py", "systems/effects/registry.py"
HOST = "systems/host.py"
KICK: Hunt = ("test_effects_anywhere.py", "kick or steep or order")
LISTED: Hunt = ("test_effects_anywhere.py", "registered or names")
LAW: Hunt = ("test_effects_anywhere.py", "new_law")

EFFECTS = (
    Mutant(
        "whole kicks for half",
        KICKS,
        "jnp.asarray(0.5 * h, s.dtype)",
        "jnp.asarray(h, s.dtype)",
        KICK,
    ),
    Mutant(
        "second kick in the first's order",
        KICKS,
        "reversed(effects)",
        "effects",
        KICK,
    ),
    Mutant(
        "on the host the second kick in the first's order",
        HOST,
        "after(size[:, ::-1], self.engine",
        "before(size, self.engine",
        ("test_window_slopes.py", "act_on_the_host"),
    ),
    Mutant(
        "the second kick's magnitudes act at the step's end alone",
        HOST,
        "        whole[..., p : p + self._count] += last",
        "        whole[..., p : p + self._count] += 0.0 * last",
        ("test_window_slopes.py", "slopes_of_its_own"),
    ),
    Mutant("drag's sign", FRICTION, "x * jnp.abs(v) * t", "x * v * t", KICK),
    Mutant(
        "drag as a step of Euler's",
        FRICTION,
        "v / (1.0 + x * jnp.abs(v) * t)",
        "v * (1.0 - x * jnp.abs(v) * t)",
        KICK,
    ),
    Mutant(
        "damping as a step of Euler's",
        FRICTION,
        "v * jnp.exp(-x * t)",
        "v * (1.0 - x * t)",
        KICK,
    ),
    Mutant(
        "dry friction without its width",
        LAWS,
        "level * t / width\n",
        "level * t\n",
        KICK,
    ),
    Mutant(
        "log sinh without its two",
        LAWS,
        " - math.log(2.0) - k",
        " - k",
        KICK,
    ),
    Mutant(
        "Stribeck's level of the start",
        FRICTION,
        "slowed_by_coulomb(v, self._level(x, middle), self.width, t)",
        "slowed_by_coulomb(v, self._level(x, v), self.width, t)",
        KICK,
    ),
    Mutant(
        "springs pull from the other side",
        "systems/effects/springs.py",
        "v + self.along(x, q, v) * t",
        "v - self.along(x, q, v) * t",
        KICK,
    ),
    Mutant(
        "priors in the input alone",
        LIST,
        "for s in (0.0 * away, away)",
        "for s in (0.0 * away,)",
        LISTED,
    ),
    Mutant(
        "priors per step",
        LIST,
        "jnp.asarray(a))) / LONGEST_MEAN",
        "jnp.asarray(a)))",
        LISTED,
    ),
    Mutant(
        "a law's prior by position alone",
        LIST,
        "(joint.reach**of_position * joint.speed**of_velocity)",
        "joint.reach**of_position",
        LAW,
    ),
    Mutant(
        "a law's unit without its seconds",
        "systems/effects/units.py",
        '("s", seconds - 2)',
        '("s", -2)',
        LAW,
    ),
    Mutant(
        "actuator tie: the constant is each input's own",
        "systems/actuators.py",
        "{self.tie or self.where}",
        "{self.where}",
        ("test_tied_actuators.py", "both_inputs or for_all"),
    ),
    Mutant(
        "actuator tie: a shared delay is proposed again",
        "systems/effects/registry.py",
        "if not isinstance(p, AbstractActuator) or p.name in there",
        "if not isinstance(p, AbstractActuator)",
        ("test_tied_actuators.py", "proposed_again"),
    ),
)
