"""Families of commands: coefficients in a box become commands that keep their limits.

A multisine is what identification has always used: few tones, smooth, easy to repeat. A
free signal has a knot every tenth of a second and is a straight line between them.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.experiment_design.limits import LimitBox, clip_commands
from sim2gp.planning.coloured_noise import coloured_noise
from sim2gp.planning.mpc import from_unit
from sim2gp.types import Box, Key

FADE = 0.25  # s, in which a multisine comes and goes
COLOUR = 1.0  # of free random motions: power falls as one over frequency


class AbstractCommandSignal(eqx.Module):
    """A map from ``(k, m)`` coefficients in ``[-1, 1]`` to commands.

    Raises `InputError` E148 for a number that cannot be.
    """

    period: float = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        checks.positive(type(self).__name__, period=self.period)
        checks.count(type(self).__name__, steps=self.steps)

    @property
    @abstractmethod
    def coefficients(self) -> int:
        """``k``, for each input."""

    @abstractmethod
    def commands(self, C: Float[Array, "k m"], limits: LimitBox) -> Float[Array, "T m"]:
        """Within the limits of value and rate, exactly."""

    @abstractmethod
    def random(self, key: Key, inputs: int) -> Float[Array, "k m"]:
        """Coefficients of a motion like any other, of sd 1: a search begins there."""


class MultisineCommands(AbstractCommandSignal):
    """Sines of ``tones`` frequencies, from one cycle in all to ``highest`` (Hz)."""

    tones: int = eqx.field(static=True, default=12)
    highest: float = eqx.field(static=True, default=3.0)

    def __check_init__(self) -> None:
        checks.count("Multisine", tones=self.tones)
        checks.positive("Multisine", highest=self.highest)

    @property
    def coefficients(self) -> int:
        return 2 * self.tones

    def commands(self, C: Float[Array, "k m"], limits: LimitBox) -> Float[Array, "T m"]:
        """Scaled as a whole where a limit of value or rate would be left."""
        t = self.period * np.arange(self.steps)
        lowest = 1.0 / (self.period * self.steps)
        f = np.linspace(lowest, max(self.highest, lowest), self.tones)
        angle = 2.0 * np.pi * t[:, None] * f[None]
        fade = np.minimum(1.0, np.minimum(t, t[-1] - t) / FADE)
        basis = fade[:, None] * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        half = jnp.minimum(-limits.low, limits.high)
        U = (jnp.asarray(basis, C.dtype) @ C) * half[None]
        steepest = jnp.max(jnp.abs(jnp.diff(U, axis=0)), axis=0) / self.period
        share = jnp.maximum(jnp.max(jnp.abs(U), axis=0) / half, steepest / limits.rate)
        # The last digits: a product may round up.
        return clip_commands(limits, U / jnp.maximum(share, 1.0)[None], self.period)

    def random(self, key: Key, inputs: int) -> Float[Array, "k m"]:
        return jax.random.normal(key, (self.coefficients, inputs))


class FreeCommands(AbstractCommandSignal):
    """Straight lines between knots ``spacing`` seconds apart."""

    spacing: float = eqx.field(static=True, default=0.1)

    def __check_init__(self) -> None:
        checks.positive("Free", spacing=self.spacing)

    @property
    def coefficients(self) -> int:
        return max(2, round(self.period * self.steps / self.spacing))

    def commands(self, C: Float[Array, "k m"], limits: LimitBox) -> Float[Array, "T m"]:
        at = np.linspace(0.0, len(C) - 1.0, self.steps)
        left = np.minimum(at.astype(int), len(C) - 2)
        share = jnp.asarray((at - left)[:, None], C.dtype)
        line = (1.0 - share) * C[left] + share * C[left + 1]
        box = Box(jnp.asarray(limits.low), jnp.asarray(limits.high))
        return clip_commands(limits, from_unit(line, box), self.period)

    def random(self, key: Key, inputs: int) -> Float[Array, "k m"]:
        none = jnp.zeros((self.coefficients, inputs))
        return coloured_noise(key, 1, none, COLOUR)[0]
