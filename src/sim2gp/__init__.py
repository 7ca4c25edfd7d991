"""sim2gp: a posterior sample is a simulator."""

__version__ = "0.1.0"
