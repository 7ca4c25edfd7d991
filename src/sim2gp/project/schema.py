"""The shape of a project file, section by section, and its faults in one line each.

    system = "two_link"                           (or a model's file, "robot.xml")
    [options]  [parameters.NAME]  [effects.CHANNEL.EFFECT]  [[weighed]]  [[logs]]
    [actuators.INPUT]  [likelihood]  [task]  [limits]  [rates]  [model]  [planner]

Types are strict: a number in quotes is text. A fault names the line of its key.
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from sim2gp.errors import InputError, nearest
from sim2gp.project.source import Path_, Source

Pair = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
Positive = Annotated[FiniteFloat, Field(gt=0)]
Count = Annotated[int, Field(gt=0)]


class Section(BaseModel):
    """A table that knows all its keys."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class PriorSpec(Section):
    """What is believed of one constant: a value, moments, a box, or both of these.

    ``relative_sd`` is a share of the mean, or of the machine's own number. ``tie``
    makes all constants of a pattern one number (of a model's file alone).
    """

    value: FiniteFloat | None = None
    mean: FiniteFloat | None = None
    sd: FiniteFloat | None = None
    relative_sd: Positive | None = None
    tie: bool = False
    low: FiniteFloat | None = None
    high: FiniteFloat | None = None
    map: Literal["box", "log_box", "log", "identity"] | None = None


class EffectSpec(PriorSpec):
    """Physics that the machine's equations lack: its magnitude, as any constant's.

    ``[effects.theta.coulomb]`` adds the constant ``theta.coulomb``; a bare number
    fixes it. ``width`` and ``speed`` (velocities) and ``smoothing`` (an input) are
    options of the effects that have them.
    """

    width: Positive | None = None
    speed: Positive | None = None
    smoothing: Positive | None = None


#: What an effect has beside the prior of its magnitude.
EFFECT_OPTIONS = tuple(
    name for name in EffectSpec.model_fields if name not in PriorSpec.model_fields
)


class ColumnSpec(Section):
    """A column of a file, and how its numbers become a channel's."""

    column: str
    unit: str | None = None
    sign: Literal[1, -1] = 1
    scale: FiniteFloat = 1.0
    offset: FiniteFloat = 0.0
    saturation: Pair | None = None


class ResampleSpec(Section):
    """How streams with clocks of their own become one: every period, or as one has it.

    With neither, at the stamps of the slowest stream that measures.
    """

    method: Literal["linear", "hold"] = "linear"
    period: Positive | None = None
    stamps: str | None = None


class LogSpec(Section):
    """A group of files with the same columns, of the machine in one configuration.

    ``time`` is a column (default "time"; in a bag "header" or "log"), or rows have a
    fixed ``period``. ``episode`` is a column of episode numbers. ``name`` is that of
    the configuration (default the group's number): ``fixed`` are constants known in it
    alone, ``free`` those that it does not share with the other groups.
    """

    files: Annotated[list[str], Field(min_length=1)]
    name: Annotated[str, Field(pattern=r"^[^\s@]+$")] | None = None
    time: str | ColumnSpec | None = None
    period: Positive | None = None
    episode: str | None = None
    resample: ResampleSpec | None = None
    keep_first: bool = False
    exclude: list[Pair] = []
    columns: dict[str, str | FiniteFloat | ColumnSpec]
    fixed: dict[str, FiniteFloat] = {}
    free: list[str] = []
    drop_nonfinite: bool = False


class WeighedSpec(Section):
    """A measured sum of constants, each times its weight (default 1)."""

    of: Annotated[list[str], Field(min_length=1)]
    weights: list[FiniteFloat] | None = None
    value: FiniteFloat
    sd: Positive


class ActuatorSpec(Section):
    """Gain, offset, delay of one input: a number fixes, a table or "free" learns."""

    gain: FiniteFloat | Literal["free"] | PriorSpec = 1.0
    offset: FiniteFloat | Literal["free"] | PriorSpec = 0.0
    delay: FiniteFloat | Literal["free"] | PriorSpec = 0.0


class LikelihoodSpec(Section):
    """Windows of a length in s (0: one step); what noise and start are allowed.

    ``start``: a window's start is guessed from the samples around it ("smoothed"), or
    from the past alone ("causal"), as whoever predicts with the model will do.
    """

    window: Annotated[FiniteFloat, Field(ge=0)] = 0.2
    start: Literal["smoothed", "causal"] = "smoothed"
    robust: bool = False
    start_sd: Positive | dict[str, Positive] | None = None
    noise_floor: Positive | dict[str, Positive] | None = None


class TaskSpec(Section):
    """What to achieve: a preset, or a target and weights by channel."""

    preset: str | None = None
    target: dict[str, FiniteFloat] = {}
    weights: dict[str, FiniteFloat] = {}
    seconds: Positive = 5.0
    period: Positive = 0.02


class ModelSpec(Section):
    """How data become a belief."""

    kind: Literal["sim2gp", "point_estimate", "prior_mean"] = "sim2gp"


class PlannerSpec(Section):
    """How a draw becomes actions."""

    kind: Literal["icem", "mppi"] = "icem"
    samples: Count | None = None
    horizon: Count | None = None
    iterations: Count | None = None
    elites: Count | None = None


class ProjectSpec(Section):
    """The whole file."""

    system: str
    options: dict[str, Any] = {}
    parameters: dict[str, FiniteFloat | PriorSpec] = {}
    effects: dict[str, dict[str, FiniteFloat | EffectSpec]] = {}
    weighed: list[WeighedSpec] = []
    logs: list[LogSpec] = []
    actuators: dict[str, ActuatorSpec] = {}
    likelihood: LikelihoodSpec = LikelihoodSpec()
    task: TaskSpec = TaskSpec()
    limits: dict[str, Pair] = {}
    rates: dict[str, Positive] = {}
    model: ModelSpec = ModelSpec()
    planner: PlannerSpec = PlannerSpec()

    def configuration(self, group: int) -> str:
        """Name of the configuration that a group of logs recorded."""
        return self.logs[group].name or str(group + 1)

    @property
    def configurations(self) -> tuple[str, ...]:
        """All of them, in the order of the file."""
        names = (self.configuration(i) for i in range(len(self.logs)))
        return tuple(dict.fromkeys(names))


def validated(source: Source) -> ProjectSpec:
    """The file's values as a `ProjectSpec`, or its first fault (E141, E148, E160)."""
    try:
        return ProjectSpec.model_validate(source.values)
    except ValidationError as failure:
        errors: list[dict[str, Any]] = [{**error} for error in failure.errors()]
    faults = [(_present(error["loc"], source.values), error) for error in errors]
    above = {path[:end] for path, _ in faults for end in range(len(path))}
    deep = [(path, error) for path, error in faults if path not in above]
    path, error = min(deep, key=lambda fault: _order(source, fault[0]))
    raise _fault(source, path, error, [e for p, e in deep if p == path])


def _present(loc: Path_, values: Any) -> Path_:
    """The part of pydantic's location that the file spells; the rest names types."""
    path: Path_ = ()
    for part in loc:
        try:
            values = values[part]
        except (KeyError, IndexError, TypeError):
            continue
        path = (*path, part)
    return path


def _order(source: Source, path: Path_) -> int:
    return int(source.where(*path).split(":line ")[1].split(",")[0])


def _keys_at(path: Path_) -> list[str]:
    """The keys that a table at this path may have."""
    section = path[0] if path else ""
    model: type[BaseModel] = ProjectSpec
    if section == "effects":
        model = EffectSpec
    elif section in ("parameters", "actuators") and len(path) > 1:
        last = section == "parameters" or len(path) > 2
        model = PriorSpec if last else ActuatorSpec
    elif section == "logs":
        inner = ResampleSpec if "resample" in path else ColumnSpec
        model = inner if len(path) > 2 else LogSpec
    elif section == "weighed":
        model = WeighedSpec
    elif section:
        model = type(ProjectSpec.model_fields[str(section)].default)
    return list(model.model_fields)


def _fault(
    source: Source, path: Path_, error: dict[str, Any], same: list[dict[str, Any]]
) -> InputError:
    kind, value = error["type"], error["input"]
    where, got = source.where(*path), repr(value)[:40]
    if kind == "missing":
        key = str(error["loc"][-1])
        return InputError(
            "E160",
            f"missing key {key}",
            where=where,
            got=_listed(value) if isinstance(value, dict) else got,
            expected=f"{key} = ...",
            fix=f"add {key}",
        )
    if kind == "extra_forbidden":
        known = _keys_at(path[:-1])
        close = nearest(str(path[-1]), known)
        return InputError(
            "E160",
            "unknown key",
            where=where,
            got=str(path[-1]),
            expected="one of " + ", ".join(known),
            fix=f"did you mean {close}" if close else "remove it",
        )
    expected = " or ".join(dict.fromkeys(_expected(e) for e in same))
    code = "E160"
    if kind == "finite_number" and path[-1] in ("low", "high"):
        code = "E141"
    elif {"sd", "start_sd", "noise_floor"} & set(path):
        code = "E144" if kind in ("greater_than", "finite_number") else "E160"
    elif path and path[0] == "planner" and kind == "greater_than":
        code = "E148"
    fix = "write the value without quotes" if _is_quoted(value, expected) else ""
    if kind == "literal_error" and isinstance(value, str):
        choices = error["ctx"]["expected"].replace("'", "").replace(" or ", ", ")
        close = nearest(value, choices.split(", "))
        fix = f"did you mean {close!r}" if close else ""
    plain = expected.startswith(("a ", "one ", "text", "true"))
    fix = fix or (f"write {expected}" if plain else "correct the value")
    return InputError(
        code, "wrong value", where=where, got=got, expected=expected, fix=fix
    )


def _listed(table: dict[str, Any]) -> str:
    return ", ".join(table)[:60] or "an empty table"


def _is_quoted(value: Any, expected: str) -> bool:
    if not isinstance(value, str) or "number" not in expected:
        return False
    try:
        float(value)
    except ValueError:
        return False
    return True


def _expected(error: dict[str, Any]) -> str:
    """Pydantic's sentence in the words of a project file."""
    kind = error["type"]
    words = {
        "float_type": "a number",
        "finite_number": "a finite number",
        "int_type": "a whole number",
        "string_type": "text in quotes",
        "string_pattern_mismatch": "a word without spaces and @",
        "bool_type": "true or false",
        "list_type": "a list in brackets",
        "dict_type": "a table",
        "model_type": "a table",
    }
    if kind in words:
        return words[kind]
    if kind == "literal_error":
        return f"one of {error['ctx']['expected']}"
    message = str(error["msg"])
    return message.removeprefix("Input should be ").lower()
