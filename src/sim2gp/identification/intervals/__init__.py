"""Intervals that hold where the simulator or the noise model is wrong."""
