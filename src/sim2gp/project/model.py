"""A model's file as the project's machine: which parameters are open, tied, and how.

    system = "robot.xml"
    [parameters."joint/*/damping"]
    tie = true
    relative_sd = 0.5

Every table of ``[parameters]`` opens what its path or pattern names; without any, all
usual parameters that are not zero in the model are open.
"""

from pathlib import Path

from sim2gp.errors import InputError, error
from sim2gp.inference.parameters import Parameter
from sim2gp.project.actuators import with_actuators
from sim2gp.project.effects import with_effects
from sim2gp.project.priors import prior, with_location
from sim2gp.project.schema import ParameterSpec, ProjectSpec
from sim2gp.project.source import ProjectSource
from sim2gp.project.validate import unknown
from sim2gp.systems import AbstractSystem, MuJoCo
from sim2gp.systems.mujoco.constants import (
    SIGNED,
    Constant,
    constants_of,
    matching,
    tied,
)
from sim2gp.systems.mujoco.system import default_prior, loaded
from sim2gp.systems.variants import AT


def build_model(
    spec: ProjectSpec, source: ProjectSource, folder: Path, other: Path | None = None
) -> AbstractSystem:
    """The machine of a model's file, or of another one, behind its actuators.

    Raises `InputError` E130 to E172.
    """
    path = folder / spec.system if other is None else other
    root = _root(spec, source, folder)
    try:
        model = loaded(path, root)
    except InputError as caught:
        raise with_location(caught, caught.where or source.where("system")) from caught
    known = constants_of(model)
    groups: list[list[str]] = []
    priors: dict[str, Parameter | float] = {}
    for pattern, stated in spec.parameters.items():
        if AT in pattern:
            continue  # a column of one configuration
        where = source.where("parameters", pattern)
        try:
            found = matching(known, pattern)
        except InputError as caught:
            raise with_location(caught, where) from caught
        # A path of its own is the exception to a pattern.
        found = [c for c in found if c.path == pattern or c.path not in spec.parameters]
        if not found:
            raise error("pattern_without_own_constants", where=where, got=pattern)
        shared = isinstance(stated, ParameterSpec) and stated.tie
        for group in tied(found, model) if shared else [[c] for c in found]:
            groups.append([c.path for c in group])
            priors[group[0].path] = _stated_prior(stated, group[0], model, where)
    try:
        plant = MuJoCo(model, groups or None, priors, source=path)
    except InputError as caught:
        raise with_location(caught, source.where("parameters")) from caught
    return with_actuators(with_effects(plant, spec.effects, source), spec, source)


def _root(spec: ProjectSpec, source: ProjectSource, folder: Path) -> Path | None:
    """The folder that the model's files must lie in, where the file names one."""
    options = dict(spec.options)
    root = options.pop("root", None)
    for name in options:
        raise unknown("option", name, ("root",), source.where("options", name))
    if not isinstance(root, str | None):
        raise unknown("folder", str(root), (), source.where("options", "root"))
    return None if root is None else folder / root


def _stated_prior(
    stated: ParameterSpec | float, constant: Constant, model: object, where: str
) -> Parameter | float:
    """What the file says, about the model's own number."""
    base = default_prior(constant, model)
    bare = ParameterSpec(tie=True)
    if base is not None and stated in (bare, ParameterSpec()):
        return base
    empty = Parameter(constant.path, constant.unit, constant.meaning, "identity")
    own = constant.get(model) if constant.quantity in SIGNED else None
    return prior(stated, base or empty, where, own)
