"""How data become a belief over dynamics."""

from sim2gp.models.auto import Auto as Auto
from sim2gp.models.auto import AutoBelief as AutoBelief
from sim2gp.models.function_space import FunctionSpace as FunctionSpace
from sim2gp.models.hybrid import HybridBelief as HybridBelief
from sim2gp.models.missing_forces import MissingForces as MissingForces
from sim2gp.models.nlm import NLM as NLM
from sim2gp.models.nlm import NLMBelief as NLMBelief
from sim2gp.models.point_estimate import PointEstimate as PointEstimate
from sim2gp.models.point_estimate import PriorMean as PriorMean
from sim2gp.models.residual import Residual as Residual
from sim2gp.models.residual_function_space import (
    ResidualFunctionSpace as ResidualFunctionSpace,
)
from sim2gp.models.sim2gp import Sim2GP as Sim2GP
from sim2gp.models.sim2gp import Sim2GPBelief as Sim2GPBelief
