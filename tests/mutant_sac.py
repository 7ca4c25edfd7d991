"""Mutants of SAC: each broken part must fail the probe world that is about it."""

from mutant_list import Mutant

SAC, NETWORKS = "planning/sac.py", "planning/networks.py"
RANDOMISED, POLICY, EXPORT = (
    "planning/domain_randomisation.py",
    "robot/policy.py",
    "robot/export.py",
)
FLIGHT = "planning/episode.py"

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
        "old + sac.tau * (new - old)",
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
        "return jnp.where(replayed, starts[row], start)",
        "return start",
        ("test_sac.py", "where_the_machine"),
    ),
    Mutant(
        "networks: a density without the slope of tanh",
        NETWORKS,
        "jnp.sum(normal - slope)",
        "jnp.sum(normal)",
        ("test_sac.py", "squashed or temperature"),
    ),
    Mutant(
        "sac: episodes never begin anywhere",
        SAC,
        "elsewhere(world, start, which)",
        "start",
        ("test_sac.py", "no_machine"),
    ),
    Mutant(
        "sac: an angle is scattered over half of its turn",
        SAC,
        "set(jnp.pi)",
        "set(0.5 * jnp.pi)",
        ("test_sac.py", "no_machine"),
    ),
    Mutant(
        "sac: every box that is scattered in is the whole one",
        SAC,
        "half = observe.scale * jax.random.uniform(how_far, (), observe.scale.dtype)",
        "half = observe.scale",
        ("test_sac.py", "no_machine"),
    ),
    Mutant(
        "sac: empty rows become steps",
        SAC,
        "valid = valid & (jnp.arange(len(valid)) < self.count)",
        "valid = valid",
        ("test_sac.py", "tried_again"),
    ),
    Mutant(
        "randomised: every episode has the mean machine",
        FLIGHT,
        "self.constants.sample(which)",
        "self.constants.mean",
        ("test_randomised.py", "each_reset"),
    ),
    Mutant(
        "randomised: constants wander",
        RANDOMISED,
        "return jnp.concatenate([s2, x[n:]])",
        "return jnp.concatenate([s2, 0.99 * x[n:]])",
        ("test_randomised.py", "each_reset"),
    ),
    Mutant(
        "policy: infinity is a full action",
        POLICY,
        "np.isfinite(s).all() and np.isfinite(mean).all()",
        "not np.isnan(s).any() and not np.isnan(mean).any()",
        ("test_export.py", "made_of_nothing"),
    ),
    Mutant(
        "policy: sine and cosine change places",
        POLICY,
        "np.sin(turn), np.cos(turn)",
        "np.cos(turn), np.sin(turn)",
        ("test_export.py", "jax_does"),
    ),
    Mutant(
        "policy: numbers of any width are run",
        "robot/format.py",
        "if found[name].dtype != np.float32:",
        "if found[name].dtype == np.float16:",
        ("test_export.py", "refused"),
    ),
    Mutant(
        "export: constants are drawn apart from each other",
        EXPORT,
        "jax.vmap(posterior.sample)(jax.random.split(key, draws))",
        "posterior.mean + posterior.sd() * jax.random.normal("
        "key, (draws, posterior.mean.size))",
        ("test_export.py", "draws_are_machines"),
    ),
)
