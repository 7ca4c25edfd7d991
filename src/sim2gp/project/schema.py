"""The shape of a project file, section by section.

    system = "two_link"                           (or a model's file, "robot.xml")
    [options]  [parameters.NAME]  [effects.CHANNEL.EFFECT]  [[weighed]]  [[logs]]
    [actuators.INPUT]  [likelihood]  [limits]  [rates]

Types are strict: a number in quotes is text. Every key here is read by some command:
one that nothing reads is an error (`sim2gp.project.validate`). The text below a key is
its row in docs/project_file.md, which ``python docs/site/tables.py`` writes.
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
    """What is known of one parameter: a value, a mean and sd, bounds, or both."""

    value: FiniteFloat | None = None
    """Fixes the parameter."""
    mean: FiniteFloat | None = None
    """Prior mean; needs `sd` or `relative_sd`."""
    sd: FiniteFloat | None = None
    """Prior standard deviation, > 0; about `mean`, or alone about the machine's own
    number."""
    relative_sd: Positive | None = None
    """The sd as a share of the mean, or of the machine's own number."""
    low: FiniteFloat | None = None
    """Lower bound."""
    high: FiniteFloat | None = None
    """Upper bound."""
    map: Map | None = None
    """The scale of the fit: `bounded` or `identity` is the value, `log_bounded` or
    `log` its logarithm. Older files say `box` and `log_box`."""


class ParameterSpec(PriorSpec):
    """A prior of a parameter of the machine, or of all that a pattern names."""

    tie: bool = False
    """All parameters of a pattern have one value for each quantity (MuJoCo models)."""


class EffectSpec(PriorSpec):
    """Physics that the machine's equations do not have; its magnitude is a parameter.

    ``[effects.theta.coulomb]`` adds the parameter ``theta.coulomb``; a bare
    number fixes it. Below are options of the effects that have them.
    """

    width: Positive | None = None
    """Velocity over which dry friction changes its sign."""
    speed: Positive | None = None
    """Velocity at which Stribeck friction falls."""
    smoothing: Positive | None = None
    """Width of the edge of a dead zone (the input's unit)."""
    points: list[Pair] | None = None
    """Of a table: pairs of the variable and of the force there, by the variable.
    Between them the force is linear, beyond them constant. Its magnitude is 1 unless
    stated."""


#: What an effect has next to the prior of its magnitude.
EFFECT_OPTIONS = tuple(
    name for name in EffectSpec.model_fields if name not in PriorSpec.model_fields
)


class ColumnSpec(Section):
    """A column of a file, and how its numbers become a channel's."""

    column: str
    """The column's name in the file."""
    unit: str | None = None
    """The file's unit (`deg`, `mm`, `ms`, `rpm`, ...); by default the channel's."""
    sign: Literal[1, -1] = 1
    """The sensor's or motor's sign."""
    scale: FiniteFloat = 1.0
    """A further factor."""
    offset: FiniteFloat = 0.0
    """In the channel's unit, added last."""
    saturation: Pair | None = None
    """In the file's unit: measurements there are masked, commands clipped."""


class ResampleSpec(Section):
    """How streams with different clocks become one table of rows.

    Without `period` and `stamps`, the rows are the stamps of the slowest stream that
    measures.
    """

    method: Literal["linear", "hold"] = "linear"
    """How states between two samples are interpolated."""
    period: Positive | None = None
    """Seconds between the rows."""
    stamps: str | None = None
    """The stream whose stamps are the rows, instead of `period`."""


class LogSpec(Section):
    """A group of files with the same columns, of the machine in one configuration."""

    files: Annotated[list[str], Field(min_length=1)]
    """Paths or patterns (`*`, `**`); folders too. A part in braces (`{robot}`) names
    the machine for `identify --each`."""
    name: Annotated[str, Field(pattern=r"^[^\s@]+$")] | None = None
    """Name of the machine's configuration; without it, the number of the group if it
    has `fixed` or `free`."""
    time: str | ColumnSpec | None = None
    """The column of time in s, or a column with its unit; "header" or "log" in a bag.
    By default the column `time`, unless `period` is given."""
    period: Positive | None = None
    """Seconds between rows, if no column has the time."""
    episode: str | None = None
    """A column of episode numbers."""
    resample: ResampleSpec | None = None
    """How streams with different clocks become one."""
    keep_first: bool = False
    """Keep the first row of each stamp instead of `E108`."""
    exclude: list[Pair] = []
    """Seconds of each log to leave out."""
    columns: dict[str, str | FiniteFloat | ColumnSpec]
    """The column of each channel. An input may be a number: `0.0` if it was not
    driven."""
    fixed: dict[str, FiniteFloat] = {}
    """Parameters known in this configuration only, such as a payload's mass."""
    free: list[str] = []
    """Parameters of this configuration only, `x @ name` in the tables; all others are
    shared."""
    drop_nonfinite: bool = False
    """Mask measurements and cut at inputs that are not finite instead of `E101`."""


class WeighedSpec(Section):
    """A measured sum of parameters, each times its weight (default 1)."""

    of: Annotated[list[str], Field(min_length=1)]
    """Parameters by name; one of a configuration as `x @ name`."""
    weights: list[FiniteFloat] | None = None
    """The weight of each in the sum, 1 if left out."""
    value: FiniteFloat
    """The sum as measured."""
    sd: Positive
    """Its standard deviation."""


class ActuatorSpec(Section):
    """Gain, offset, delay of one input: a number fixes, a table or "free" learns."""

    gain: FiniteFloat | Literal["free"] | PriorSpec = 1.0
    """Factor; free: within 0.5 and 2."""
    offset: FiniteFloat | Literal["free"] | PriorSpec = 0.0
    """In the input's unit; free: within a tenth of its range."""
    delay: FiniteFloat | Literal["free"] | PriorSpec = 0.0
    """Seconds; free: from 0 to 0.02."""
    tie: bool = False
    """All inputs of a pattern share gain, offset and delay."""


class LikelihoodSpec(Section):
    """The windows of the fit: their length, their starts, and the noise."""

    window: Annotated[FiniteFloat, Field(ge=0)] | None = None
    """Length in s: the simulator starts again after it. 0 predicts each row from the
    one before, and needs every state measured. Left out: 0.2, and then up to 5 while
    the [misfit tests](misfit.md) find nothing."""
    start: Literal["smoothed", "causal"] = "smoothed"
    """Which samples give the first guess of a window's start: those around it, or only
    past ones, as in a forecast."""
    robust: bool = False
    """Windows that do not fit count less (Student-t, 4 degrees of freedom): for pushes
    and collisions."""
    start_sd: Positive | dict[str, Positive] | None = None
    """Sd of the start about that guess, by channel or for all. By default 100 sensor
    steps of a measured state, or 3 times its noise if that is more; of others 3 times
    the error of the guess, more in windows below 2 s."""
    noise_floor: Positive | dict[str, Positive] | None = None
    """The smallest noise sd, by channel or for all; by default the sensor's step, which
    is read from the log."""


class ProjectSpec(Section):
    """The whole file."""

    system: str
    """A bundled [machine](#machines), or the path of an MJCF or URDF file."""
    options: dict[str, Any] = {}
    """Settings of the [machine](#machines). For an MJCF or URDF file: `root`, the
    folder that has all its parts."""
    parameters: dict[str, FiniteFloat | ParameterSpec] = {}
    """What is known about its parameters before the logs."""
    effects: dict[str, dict[str, FiniteFloat | EffectSpec]] = {}
    """[physics](#effectschannelname) that its equations do not have."""
    weighed: list[WeighedSpec] = []
    """[sums of parameters](#weighed) that were measured, for example on a scale."""
    logs: list[LogSpec] = []
    """Groups of recordings."""
    actuators: dict[str, ActuatorSpec] = {}
    """What lies between a command and the force."""
    likelihood: LikelihoodSpec = LikelihoodSpec()
    """How the fit compares simulator and recordings."""
    limits: dict[str, Pair] = {}
    """By channel, in its unit, for the next experiment; samples of a log beyond a
    state's limits are masked."""
    rates: dict[str, Positive] = {}
    """By input, its unit per second: the steepest command of an experiment."""

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
