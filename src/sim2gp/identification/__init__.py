"""Which parameters do logs determine, how well, and what do they leave open."""

from sim2gp.identification import diagnose
from sim2gp.identification.fit import fit_windows

__all__ = ["diagnose", "fit_windows"]
