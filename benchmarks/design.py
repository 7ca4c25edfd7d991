"""Designed experiments beside what one would run otherwise, on arms with friction.

    python benchmarks/design.py [--truths N] [--seconds S] [--workers N] [--out DIR]

Hidden two-link arms are drawn from CAD priors. Each is excited for S seconds within the
same limits of torque, torque rate, position and velocity and with the same energy: by
random input, by a multisine that was optimised for the prior's middle alone (the
field's standard), by `sim2gp design` (multisine and free). The log, with sensor noise,
is fitted by the likelihood of `sim2gp identify`. Compared are the realised errors of
the constants, those of a held-out motion, the posterior's volume, and the predicted sd.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sim2gp.design import (
    Everything,
    Experiment,
    Free,
    Limits,
    Multisine,
    after,
    design,
    information,
    search,
    trajectory,
)
from sim2gp.design.limits import excess
from sim2gp.gaussian import Gaussian
from sim2gp.logs import Log
from sim2gp.models.cutting import cut
from sim2gp.models.windows import fit_windows
from sim2gp.parameters import Parameters
from sim2gp.runs.workers import cores, spread
from sim2gp.systems import TwoLink
from sim2gp.types import in_float64

PERIOD, WINDOW = 0.01, 0.2
NOISE = 1e-3  # rad, of both encoders
LIMITS = {
    "torque1": (-4.0, 4.0),
    "torque2": (-3.0, 3.0),
    "q1": (-1.6, 1.6),
    "q2": (-1.8, 1.8),
    "q1.velocity": (-6.0, 6.0),
    "q2.velocity": (-9.0, 9.0),
}
RATES = {"torque1": 40.0, "torque2": 40.0}
#: CAD: relative sd of masses and lengths, and of friction, which no drawing knows.
GEOMETRY, FRICTION = 0.15, 0.5
METHODS = ("random", "multisine", "design", "design free")
#: The project's goals: error beside random input's and the multisine's; calibration.
OF_RANDOM, OF_MULTISINE, CALIBRATED = 0.5, 0.9, (0.8, 1.25)


class Job(NamedTuple):
    method: str
    seed: int
    seconds: float
