"""Which parameters do logs determine, how well, and what do they leave open."""

from sim2gp.data.windows import fit_windows
from sim2gp.identification import diagnose

__all__ = ["diagnose", "fit_windows"]
