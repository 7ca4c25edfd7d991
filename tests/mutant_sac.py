"""Mutants of SAC: each broken part must fail the probe world that is about it."""

from mutant_list import Mutant

SAC, NETWORKS = "planning/sac.py", "planning/networks.py"

OFF_POLICY = (
    Mutant(
        "sac: no future",
        SAC,
        "y = sac.scale * r + sac.discount * after",
        "y = sac.scale * r + 0.0 * after",
        ("test_sac.py", "discounted or no_end"),
    ),
    Mutant(
        "sac: an episode's last step is its end",
        SAC,
        "jnp.where(over, 0, t + 1), (s, u, s2, r, usable)",
        "jnp.where(over, 0, t + 1), (s, u, s2, r, usable & ~over)",
        ("test_sac.py", "no_end"),
    ),
    Mutant(
        "sac: critics look at the next state's reward",
        SAC,
        "each = (_values(critics, O, U) - y[:, None]) ** 2",
        "each = (_values(critics, O2, U) - y[:, None]) ** 2",
        ("test_sac.py", "discounted"),
    ),
    Mutant(
        "sac: the higher critic is believed",
        SAC,
        "after = jnp.min(_values(learner.targets, O2, U2), axis=1)",
        "after = 2.0 * jnp.max(_values(learner.targets, O2, U2), axis=1)",
        ("test_sac.py", "discounted"),
    ),
    Mutant(
        "sac: the slow critics never follow",
        SAC,
        "old + sac.slow * (new - old)",
        "old",
        ("test_sac.py", "discounted or no_end"),
    ),
    Mutant(
        "sac: the actor runs from what is worth most",
        SAC,
        "share * (alpha * log_pi - worth)",
        "share * (alpha * log_pi + worth)",
        ("test_sac.py", "actor_finds"),
    ),
    Mutant(
        "sac: the temperature is never learned",
        SAC,
        "-(log_pi + wanted)",
        "0.0 * (log_pi + wanted)",
        ("test_sac.py", "temperature"),
    ),
    Mutant(
        "sac: half of the entropy that is wanted",
        SAC,
        "wanted = -float(U.shape[1])",
        "wanted = -0.5 * float(U.shape[1])",
        ("test_sac.py", "temperature"),
    ),
    Mutant(
        "sac: rows of an older world are kept as they were",
        SAC,
        "return Replay(self.state, self.action, S2, r, valid, self.count)",
        "return self",
        ("test_sac.py", "tried_again"),
    ),
    Mutant(
        "sac: what the world could not follow is learned",
        SAC,
        "weight = valid.astype(r.dtype)",
        "weight = jnp.ones_like(r)",
        ("test_sac.py", "cannot_follow"),
    ),
    Mutant(
        "sac: episodes never begin where the machine was",
        SAC,
        "return jnp.where(seen, starts[row], world.reset(how))",
        "return world.reset(how)",
        ("test_sac.py", "where_the_machine"),
    ),
    Mutant(
        "networks: a density without the slope of tanh",
        NETWORKS,
        "jnp.sum(normal - slope)",
        "jnp.sum(normal)",
        ("test_sac.py", "squashed or temperature"),
    ),
)
