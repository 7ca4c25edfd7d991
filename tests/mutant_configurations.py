"""Mutants of joint fits of several configurations, and of weighed sums."""

from mutant_list import Mutant

GATHER, MACHINES = "systems/variants.py", "systems/assemble.py"
SUMS, PRIOR = "inference/linear_measurements.py", "inference/prior.py"
HERE, WEIGHED = "test_configurations.py", "test_weighed.py"
CLOSED = (HERE, "closed_form")
ROW = (WEIGHED, "one_more_row")

CONFIGURATIONS = (
    Mutant(
        "configurations: everybody is the first",
        GATHER,
        "for c in variants])[index]",
        "for c in variants])[0 * index]",
        (HERE, "has_its_constants"),
    ),
    Mutant(
        "configurations: a known value is shared",
        GATHER,
        "alone = constant in self.own or constant in dict(self.fixed)",
        "alone = constant in self.own",
        (HERE, "has_its_constants"),
    ),
    Mutant(
        "configurations: windows of the wrong machine",
        "data/windows_likelihood.py",
        "values = self.system.values(tt, window.configuration)",
        "values = self.system.values(tt, 0 * window.configuration)",
        CLOSED,
    ),
    Mutant(
        "configurations: own columns without their priors",
        GATHER,
        "prior = given.pop(column, p)",
        "prior = given.pop(column, p) and p",
        CLOSED,
    ),
    Mutant(
        "configurations: one step of the wrong machine",
        "data/one_step.py",
        "return system.transition(tt + scale @ x, s, a, self.dt, which)[:d]",
        "i, at = which if which is None else 0 * which, tt + scale @ x\n"
        "                return system.transition(at, s, a, self.dt, i)[:d]",
        (HERE, "one_step"),
    ),
    Mutant(
        "configurations: a lone machine's belief out of order",
        MACHINES,
        "jnp.asarray(belief.scale)[at])",
        "jnp.asarray(belief.scale)[at[::-1]])",
        (HERE, "alone"),
    ),
    Mutant(
        "configurations: delays beyond what is kept",
        MACHINES,
        "if not 0.0 <= low <= high <= longest:",
        "if not 0.0 <= low <= high:",
        (HERE, "delay"),
    ),
    Mutant(
        "configurations: a known value clipped to the bounds",
        "systems/plants/external.py",
        "np.minimum(by.low, theta), np.maximum(by.high, theta)",
        "np.minimum(by.low, np.inf), np.maximum(by.high, -np.inf)",
        (HERE, "on_the_host"),
    ),
    Mutant(
        "configurations: more rows forget whose they are",
        "data/transitions.py",
        "which[:count] = np.asarray(self.configuration)[:count]",
        "which[:count] = 0",
        (HERE, "one_step"),
    ),
    Mutant(
        "configurations: a column for what is known",
        GATHER,
        "if column == p.name or column in own:",
        "if column == p.name or AT in column:",
        (HERE, "columns_are"),
    ),
    Mutant(
        "weighed: an sd too narrow",
        SUMS,
        "for w, name in terms) - x.value) / x.sd",
        "for w, name in terms) - x.value) / x.sd**2",
        ROW,
    ),
    Mutant(
        "weighed: no weights",
        SUMS,
        "sum(w * values[name] for",
        "sum(values[name] + 0.0 * w for",
        (WEIGHED, "keep_their_sum"),
    ),
    Mutant(
        "weighed: not in the cost",
        "inference/levenberg_marquardt.py",
        "+ offset @ offset)",
        "+ z @ z)",
        ROW,
    ),
    Mutant(
        "weighed: not in the posterior",
        "inference/laplace.py",
        "return Laplace(at, arrow, stack(arrow.data, at.prior))",
        "return Laplace(at, arrow, stack(arrow.data, at.prior[: at.z.size]))",
        ROW,
    ),
    Mutant(
        "weighed: not in the gradient",
        "inference/levenberg_marquardt.py",
        "+ rows[:, :-1].T @ offset",
        "+ z",
        (WEIGHED, "gradient"),
    ),
    Mutant(
        "weighed: linearised about the prior's mean",
        PRIOR,
        "about = rows.at[:, -1].add(-rows[:, :-1] @ z)",
        "about = rows",
        (WEIGHED, "prior_to_the_logs or keep_their_sum"),
    ),
    Mutant(
        "weighed: information in the old prior's units",
        "inference/estimate.py",
        "information=self.information @ change",
        "information=self.information",
        (WEIGHED, "prior_to_the_logs"),
    ),
    Mutant(
        "weighed: lost when a candidate is tried",
        MACHINES,
        "table, places = machine.parameters, {part.place for part in parts}",
        "table, places = machine.plant.parameters, {part.place for part in parts}",
        (WEIGHED, "candidate"),
    ),
    Mutant(
        "weighed: bounds with the signs of the weights forgotten",
        SUMS,
        "pick(w * end for end in ranges[name])",
        "abs(w) * pick(ranges[name])",
        (WEIGHED, "says_what"),
    ),
)
