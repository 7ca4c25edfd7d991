"""The names that users build on; removing one is a change for all of them."""

import re
from pathlib import Path

import pytest

import sim2gp as sg

NAMES = """
AbstractBelief AbstractModel AbstractPlanner AbstractSystem Auto Box Channel
FunctionSpace Gaussian ICEM InputError Limits Log MPC MPPI Machine MissingForces NLM
Parameter
Parameters PointEstimate PriorMean Progress Residual ResidualFunctionSpace SAC Sim2GP
Sim2GPError Task Transitions Windows World __version__ apply bench bounded compare cut
demo design diagnose episode evaluate example explain export fit_windows identify
identify_fleet init load_project load_run log_bounded optimism positive
posterior_sampling
project_of_machine psal psrl read_logs reproduce rollout selftest show signed sinks
systems tasks
"""
#: Of `sim2gp.systems`, what a system of one's own is made with.
SYSTEMS = """
AbstractMechanism AbstractODE AbstractPlant AbstractSystem BlackBox Bound CartPole
Channel Furuta Machine MuJoCo ODE TwoLink free_parts rk4 with_parts
"""
DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_public_names_stay() -> None:
    assert set(dir(sg)) == set(NAMES.split())
    for name in dir(sg):
        assert getattr(sg, name) is not None
    assert set(SYSTEMS.split()) <= set(sg.systems.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Sim3GP'"):
        _ = sg.Sim3GP


@pytest.mark.parametrize("thing", ["system", "model", "planner"])
def test_what_one_brings_needs_public_names_alone(thing: str) -> None:
    page = (DOCS / f"your_{thing}.md").read_text(encoding="utf-8")
    assert not re.findall(r"sim2gp\.\w+ import|import sim2gp\.\w+", page)
    assert set(re.findall(r"\bsg\.(\w+)", page)) <= set(NAMES.split())
