"""Gaussian inference by square roots; knows no robot."""
