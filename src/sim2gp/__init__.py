"""sim2gp: a posterior sample is a simulator.

A differentiable simulator with bounded physical parameters becomes a Gaussian belief
over dynamics; draws from it are simulators again, and drive control and experiments.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# The table of contents: modules, and the modules of other names. Nothing is imported
# before it is used, so that asking for help or for the version costs nothing.
_MODULES = {
    "systems": "systems",
    "tasks": "planning.tasks",
    "diagnose": "identification.diagnose",
    "sinks": "runs.sinks",
}
_CONTENTS = {
    "identify": "commands.identify",
    "identify_fleet": "commands.fleet",
    "evaluate": "commands.evaluate",
    "explain": "commands.explain",
    "compare": "commands.compare",
    "design": "commands.design",
    "apply": "commands.apply",
    "export": "commands.export",
    "demo": "commands.demo",
    "example": "commands.example",
    "init": "commands.init",
    "selftest": "commands.selftest",
    "bench": "commands.bench",
    "reproduce": "commands.reproduce",
    "load_run": "commands.load_run",
    "Limits": "experiment_design.verdict",
    "Log": "data.logs",
    "Machine": "systems",
    "Progress": "runs",
    "load_project": "project",
    "project_of_machine": "project.in_memory",
    "read_logs": "project.in_memory",
    "Box": "types",
    "Gaussian": "inference.gaussian",
    "Parameter": "inference.parameters",
    "Parameters": "inference.parameters",
    "bounded": "inference.parameters",
    "log_bounded": "inference.parameters",
    "positive": "inference.parameters",
    "signed": "inference.parameters",
    "Transitions": "data.transitions",
    "Windows": "data.windows",
    "cut": "data.split_log",
    "AbstractSystem": "systems",
    "Channel": "systems",
    "AbstractModel": "belief",
    "AbstractBelief": "belief",
    "Sim2GP": "models",
    "MissingForces": "models",
    "NLM": "models",
    "Residual": "models",
    "FunctionSpace": "models",
    "ResidualFunctionSpace": "models",
    "Auto": "models",
    "PointEstimate": "models",
    "PriorMean": "models",
    "fit_windows": "identification.fit",
    "World": "planning",
    "rollout": "planning",
    "AbstractPlanner": "planning",
    "MPC": "planning",
    "ICEM": "planning",
    "MPPI": "planning",
    "SAC": "planning",
    "Task": "planning.tasks",
    "episode": "planning.episode",
    "posterior_sampling": "planning.loop",
    "psrl": "planning.loop",
    "psal": "planning.loop",
    "optimism": "planning.loop",
    "show": "reports",
    "InputError": "errors",
    "Sim2GPError": "errors",
}
__all__ = ["__version__", *_MODULES, *_CONTENTS]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"sim2gp.{_MODULES[name]}")
    if name not in _CONTENTS:
        raise AttributeError(f"module 'sim2gp' has no attribute {name!r}")
    return getattr(import_module(f"sim2gp.{_CONTENTS[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
