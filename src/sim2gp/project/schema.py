"""The shape of a project file, section by section.

    system = "two_link"                           (or a model's file, "robot.xml")
    [options]  [parameters.NAME]  [effects.CHANNEL.EFFECT]  [[weighed]]  [[logs]]
    [actuators.INPUT]  [likelihood]  [limits]  [rates]

Types are strict: a number in quotes is text. Every key here is read by some command:
one that nothing reads is an error (`sim2gp.project.validate`).
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat

from sim2gp.project.source import Path_

Pair = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
Positive = Annotated[FiniteFloat, Field(gt=0)]

#: Sections that have a meaning once a command reads them; an error until then.
RESERVED = ("task", "model", "planner")


class Section(BaseModel):
    """A table that knows all its keys."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


#: How a parameter is unbounded; older files say ``box`` and ``log_box``.
Map = Annotated[
    Literal["bounded", "log_bounded", "log", "identity"],
    BeforeValidator(lambda x: _OLDER.get(x, x) if isinstance(x, str) else x),
]
_OLDER = {"box": "bounded", "log_box": "log_bounded"}


class PriorSpec(Section):
    """What is believed of one constant: a value, moments, a box, or both of these.

    ``sd`` or ``relative_sd`` (a share) alone are about the machine's own number.
    """

    value: FiniteFloat | None = None
    mean: FiniteFloat | None = None
    sd: FiniteFloat | None = None
    relative_sd: Positive | None = None
    low: FiniteFloat | None = None
    high: FiniteFloat | None = None
    map: Map | None = None


class ParameterSpec(PriorSpec):
    """A prior of a constant of the machine, or of all that a pattern names.

    ``tie`` makes the constants of a pattern one number for each quantity (of a model's
    file alone).
    """

    tie: bool = False


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
    """Gain, offset, delay of one input: a number fixes, a table or "free" learns.

    ``tie`` makes all inputs of a pattern share each of the three.
    """

    gain: FiniteFloat | Literal["free"] | PriorSpec = 1.0
    offset: FiniteFloat | Literal["free"] | PriorSpec = 0.0
    delay: FiniteFloat | Literal["free"] | PriorSpec = 0.0
    tie: bool = False


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


class ProjectSpec(Section):
    """The whole file."""

    system: str
    options: dict[str, Any] = {}
    parameters: dict[str, FiniteFloat | ParameterSpec] = {}
    effects: dict[str, dict[str, FiniteFloat | EffectSpec]] = {}
    weighed: list[WeighedSpec] = []
    logs: list[LogSpec] = []
    actuators: dict[str, ActuatorSpec] = {}
    likelihood: LikelihoodSpec = LikelihoodSpec()
    limits: dict[str, Pair] = {}
    rates: dict[str, Positive] = {}

    def configuration(self, group: int) -> str:
        """Name of the configuration that a group of logs recorded."""
        return self.logs[group].name or str(group + 1)

    @property
    def configurations(self) -> tuple[str, ...]:
        """All of them, in the order of the file."""
        names = (self.configuration(i) for i in range(len(self.logs)))
        return tuple(dict.fromkeys(names))


#: The tables of a project file: header, path ("*" is a name of the user's), keys.
TABLES: tuple[tuple[str, tuple[str, ...], type[Section]], ...] = (
    ("the file", (), ProjectSpec),
    ("[parameters.NAME]", ("parameters", "*"), ParameterSpec),
    ("[effects.CHANNEL.NAME]", ("effects", "*", "*"), EffectSpec),
    ("[[weighed]]", ("weighed",), WeighedSpec),
    ("[[logs]]", ("logs",), LogSpec),
    ("[logs.columns.CHANNEL]", ("logs", "columns", "*"), ColumnSpec),
    ("[logs.time]", ("logs", "time"), ColumnSpec),
    ("[logs.resample]", ("logs", "resample"), ResampleSpec),
    ("[actuators.INPUT]", ("actuators", "*"), ActuatorSpec),
    ("[actuators.INPUT.NAME]", ("actuators", "*", "*"), PriorSpec),
    ("[likelihood]", ("likelihood",), LikelihoodSpec),
)


def keys_at(path: Path_) -> list[str]:
    """The keys that the table at a path may have; none where keys are names."""
    names = [part for part in path if isinstance(part, str)]
    for _, shape, model in TABLES:
        if len(shape) == len(names) and all(
            part in ("*", name) for part, name in zip(shape, names, strict=True)
        ):
            return list(model.model_fields)
    return []
