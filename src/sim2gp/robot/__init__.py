"""What runs next to a machine. Reading and evaluating a policy needs no JAX."""

from sim2gp.robot.policy import NumpyPolicy as NumpyPolicy
from sim2gp.robot.policy import load_policy as load_policy
