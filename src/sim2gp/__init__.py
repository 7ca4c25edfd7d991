"""sim2gp: a posterior sample is a simulator.

A differentiable simulator with bounded physical parameters becomes a Gaussian belief
over dynamics; draws from it are simulators again, and drive control and experiments.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# The table of contents. Nothing is imported before it is used, so that asking for help
# or for the version costs nothing.
_CONTENTS = {
    "systems": "",
    "tasks": "",
    "diagnose": "",
    "load_project": "project",
    "sinks": "runs",
    "Box": "types",
    "Gaussian": "gaussian",
    "Parameter": "parameters",
    "Parameters": "parameters",
    "bounded": "parameters",
    "log_bounded": "parameters",
    "positive": "parameters",
    "signed": "parameters",
    "Transitions": "transitions",
    "AbstractSystem": "systems",
    "Channel": "systems",
    "AbstractModel": "models",
    "AbstractBelief": "models",
    "Sim2GP": "models",
    "NLM": "models",
    "Residual": "models",
    "FunctionSpace": "models",
    "ResidualFunctionSpace": "models",
    "Auto": "models",
    "PointEstimate": "models",
    "PriorMean": "models",
    "Windows": "models",
    "cut": "models",
    "fit_windows": "models",
    "World": "planning",
    "rollout": "planning",
    "AbstractPlanner": "planning",
    "MPC": "planning",
    "ICEM": "planning",
    "MPPI": "planning",
    "SAC": "planning",
    "Task": "tasks",
    "episode": "flight",
    "posterior_sampling": "loops",
    "psrl": "loops",
    "psal": "loops",
    "optimism": "loops",
    "load_run": "runs",
    "show": "report",
    "InputError": "errors",
    "Sim2GPError": "errors",
}
__all__ = ["__version__", *_CONTENTS]


def __getattr__(name: str) -> Any:
    if name not in _CONTENTS:
        raise AttributeError(f"module 'sim2gp' has no attribute {name!r}")
    home = _CONTENTS[name]
    if not home:
        return import_module(f"sim2gp.{name}")
    return getattr(import_module(f"sim2gp.{home}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
