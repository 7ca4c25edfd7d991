"""Which column of a log is which channel of a machine: by names, units and rates.

Names are compared word by word (`pos_meas1` is a position, of the first joint). A
column whose integral another one follows is a velocity, under any name. The slope gives
the units and signs in which the two differ.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
from jaxtyping import Float

from sim2gp.data.logs import Column
from sim2gp.data.logs.checks import follows
from sim2gp.data.logs.table import missing_column
from sim2gp.data.logs.units import UNITS
from sim2gp.errors import InputError, error
from sim2gp.systems.base import Channel, index_of

Values = Float[np.ndarray, " N"]
Words = tuple[str, ...]


def _word_set(text: str) -> frozenset[str]:
    return frozenset(text.split())


TIME = _word_set("t time timestamp timestamps stamp sec secs seconds clock")
POSITION = _word_set("q pos position positions qpos angle encoder enc")
VELOCITY = _word_set(
    "v dq qd qvel vel velocity velocities dot qdot speed omega rate gyro"
)
INPUT = _word_set(
    "u a tau torque cmd command commanded con control ctrl input action act effort "
    "force voltage volt motor pwm"
)
#: What the only joint that slides, or the only one that turns, is called elsewhere.
_KIND = {
    "m": _word_set("x y z cart carriage slide slider trolley"),
    "rad": _word_set("theta phi psi alpha beta angle pole pendulum rod hinge"),
}
#: Not the thing itself: what it should be, and what somebody made of it.
_AIMED = _word_set("des desired ref reference target goal setpoint err error fric")
_MADE = _word_set("filt filtered smooth smoothed est estimate estimated")
_MEASURED = _word_set("meas measured actual feedback")
_SPELT = {
    **{unit.lower(): unit for unit in UNITS if unit != "mN m"},
    "degree": "deg",
    "degrees": "deg",
    "radians": "rad",
    "nm": "N m",
    "seconds": "s",
}
#: The last word of a name that can be nothing but a unit.
_PLAIN = _word_set("deg degree degrees rad rpm mm cm ms us ns")
#: Slope of a position on the integral of its velocity -> the units of both.
_OF_SLOPE: dict[float, tuple[str | None, str | None]] = {
    1.0: (None, None),
    180 / np.pi: ("deg", None),
    np.pi / 180: (None, "deg/s"),
    0.5 / np.pi: ("turn", None),
    2 * np.pi: (None, "turn/s"),
    2 * np.pi / 60: (None, "rpm"),
    1e3: ("mm", None),
    1e-3: (None, "mm/s"),
}
_ROWS = 20_000  # that are looked at for one column being another's rate
_SURE = 0.9  # a correlation that makes it so
_ENOUGH = 1.0  # of a score


@dataclass(frozen=True)
class Match:
    """The column of a channel, and in words why."""

    column: Column
    why: str


def words_of(name: str) -> Words:
    """`pos_meas1`, `posMeas1` and `pos meas [deg] 1` are pos, meas and 1."""
    plain = re.sub(r"[\[(][^\])]*[A-Za-z%][^\])]*[\])]", " ", name)
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", plain)
    return tuple(word.lower() for word in re.findall(r"[A-Za-z]+|\d+", apart))


def unit_in(name: str) -> str | None:
    """The unit that a name states: ``q1 [deg]``, ``speed (rpm)``, ``t_ms``."""
    inside = re.search(r"[\[(]\s*([^\])]+?)\s*[\])]", name)
    if inside:
        return _SPELT.get(inside.group(1).lower())
    last = words_of(name)[-1:]
    return _SPELT[last[0]] if last and last[0] in _PLAIN else None


def time_column(columns: Mapping[str, Values], where: str) -> Match:
    """The column of time and its unit, by name and how it grows (E103, E116)."""
    grow = [name for name, x in columns.items() if _grows(x)]
    named = [name for name in grow if TIME & set(words_of(name))]
    rows = min((len(x) for x in columns.values()), default=3)
    if rows < 3:
        raise error("too_short_to_draft", where=where, got=f"{rows} rows")
    if not grow:
        raise error("no_column_of_time", where=where, got=", ".join(columns)[:120])
    name = (named or grow)[0]
    why = "by name" if named else "it grows"
    steps = np.diff(columns[name])
    period = float(np.median(steps[steps > 0]))
    unit = unit_in(name)
    if unit is None or UNITS[unit][0] != "time":
        marks = (("ns", 5e5), ("us", 500.0), ("ms", 0.5), ("s", 0.0))
        unit = next(u for u, least in marks if period >= least)
        why += f", a step of {period:g}"
    return Match(Column(name, None if unit == "s" else unit), why)


def _grows(x: Values) -> bool:
    whole = len(x) > 2 and bool(np.isfinite(x).all())
    return whole and bool(np.all(np.diff(x) >= 0) and x[-1] > x[0])


def match(
    columns: Mapping[str, Values],
    time: Values,
    states: Sequence[Channel],
    actions: Sequence[Channel],
    where: str,
    given: Mapping[str, str] | None = None,
) -> dict[str, Match]:
    """The columns of positions, velocities and inputs, by channel.

    ``columns`` without that of time, whose values are in s; those of channels that are
    ``given`` are not looked for. Raises `InputError` E103 where no joint finds a
    column, or not every input, and for a channel or column that is not there.
    """
    given = given or {}
    known = _as_given(given, (*states, *actions), columns, where)
    links = _links(columns, time)
    columns = {k: v for k, v in columns.items() if k not in given.values()}
    all_joints = [c for c in states if not c.name.endswith(".velocity")]
    states, actions, joints = (
        [c for c in each if c.name not in known]
        for each in (states, actions, all_joints)
    )
    integrals, rates = {i for i, _ in links}, {j for _, j in links}
    # What swings is its own second derivative: in both, a column can be either.
    seen = {k: 1.0 if k in integrals else -2.0 * (k in rates) for k in columns}
    found = known | _assigned(joints, columns, POSITION, VELOCITY | INPUT, seen)
    if not any(c.name in found for c in all_joints):
        raise _unmatched("joint", all_joints, columns, where)
    for c in states:
        joint = found.get(c.name.removesuffix(".velocity"))
        if joint is not None and c.name.endswith(".velocity"):
            _match_velocity(c, joint, found, columns, links)
    used = {m.column.column for m in found.values()}
    free = {k: v for k, v in columns.items() if k not in used}
    # A controller's command follows the motion, one that never changes says nothing.
    moves = {
        name: -0.5 * (name in integrals | rates) - 1.0 * (np.ptp(x) == 0.0)
        for name, x in free.items()
    }
    inputs = _assigned(actions, free, INPUT, POSITION | VELOCITY, moves)
    missing = [c for c in actions if c.name not in inputs]
    taken = {m.column.column for m in inputs.values()}
    left = [k for k in free if k not in taken and moves[k] >= -0.5]
    if missing and len(left) == len(missing):
        pairs = zip(missing, left, strict=True)
        inputs |= {c.name: _stated_unit(c, k, "nothing else is left") for c, k in pairs}
    elif missing:
        raise _unmatched("input", missing, free, where)
    return found | inputs


def _as_given(
    given: Mapping[str, str],
    channels: Sequence[Channel],
    columns: Mapping[str, Values],
    where: str,
) -> dict[str, Match]:
    """Columns of channels that the user names."""
    found = {}
    for name, column in given.items():
        channel = channels[index_of(name, channels, where="the columns given")]
        if column not in columns:
            raise missing_column(column, tuple(columns), where)
        found[name] = _stated_unit(channel, column, "as given")
    return found


def _links(
    columns: Mapping[str, Values], time: Values
) -> dict[tuple[str, str], tuple[float, float]]:
    """Slope and correlation of (position, velocity), where one is the other's rate."""
    rows = slice(0, _ROWS)
    moving = {
        name: x[rows]
        for name, x in columns.items()
        if np.isfinite(x[rows]).all() and np.ptp(x[rows]) > 0
    }
    links = {}
    for i, q in moving.items():
        for j, dq in moving.items():
            found = follows(time[rows], q, dq) if i != j else None
            if found is not None and abs(found[1]) > _SURE:
                links[i, j] = found
    return links


def _assigned(
    channels: Sequence[Channel],
    columns: Mapping[str, Values],
    role: frozenset[str],
    others: frozenset[str],
    seen: Mapping[str, float],
) -> dict[str, Match]:
    """Each column to at most one channel, such that names fit best altogether."""
    if not (channels and columns):
        return {}
    spelt = {name: words_of(name) for name in columns}
    zero = any("0" in words for words in spelt.values())
    units = [c.unit for c in channels]
    kinds = {u: words for u, words in _KIND.items() if units.count(u) == 1}
    scores = np.array(
        [
            [
                _alike(c, k + (not zero), spelt[name], kinds)
                + _of_role(set(spelt[name]), role, others)
                + seen[name]
                for name in columns
            ]
            for k, c in enumerate(channels)
        ]
    )
    names = list(columns)
    rows, places = scipy.optimize.linear_sum_assignment(scores, maximize=True)
    return {
        channels[i].name: _stated_unit(channels[i], names[j], "by name")
        for i, j in zip(rows, places, strict=True)
        if scores[i, j] >= _ENOUGH
    }


def _alike(
    channel: Channel, number: int, words: Words, kinds: Mapping[str, frozenset[str]]
) -> float:
    """How much of a channel's own name a column's has; else its number or kind."""
    plain = POSITION | VELOCITY | INPUT
    own = [w for w in words_of(channel.name) if w not in plain]
    own = own or list(words_of(channel.name))
    share = 2.0 * sum(w in words for w in own) / len(own)
    numbered = any(w.isdigit() for w in own)
    if share:
        return share
    counted = 0.75 * (str(number) in words and not numbered)
    return max(counted, 1.0 * bool(kinds.get(channel.unit, frozenset()) & set(words)))


def _of_role(words: set[str], role: frozenset[str], others: frozenset[str]) -> float:
    """Whether a column's words say that it is a position, a velocity, an input."""
    fits = 1.0 if words & role else -1.5 if words & others else 0.0
    sent = "cmd" in role
    return (
        fits
        - 1.0 * bool(words & _AIMED)
        - 0.5 * bool(words & _MADE)
        - (0.75 if sent else 0.0) * bool(words & (_MEASURED | {"output"}))
    )


def _match_velocity(
    channel: Channel,
    joint: Match,
    found: dict[str, Match],
    columns: Mapping[str, Values],
    links: Mapping[tuple[str, str], tuple[float, float]],
) -> None:
    """The velocity of a joint whose position has a column; units of both by the slope.

    Nothing is taken for it that its position does not follow.
    """
    position = joint.column.column
    used = {m.column.column for m in found.values()}
    words = set(words_of(position))

    def fits(name: str) -> float:
        own = set(words_of(name))
        shared = len(own & words) / len(words)
        return (
            shared + _of_role(own, VELOCITY, POSITION) + links[position, name][1] ** 2
        )

    rates = [j for i, j in links if i == position and j not in used]
    if not rates:
        return
    name = max(rates, key=fits)
    slope, correlation = links[position, name]
    near = min(_OF_SLOPE, key=lambda s: abs(np.log(abs(slope) / s)))
    why = f"its rate (correlation {abs(correlation):.2f}"
    if not abs(slope) / near < 1.3 or not abs(slope) / near > 1 / 1.3:
        return  # of some other kind: the position alone is safer
    of_position, of_velocity = _OF_SLOPE[near]
    kind = "angular velocity" if channel.unit == "rad/s" else "velocity"
    if of_velocity and UNITS[of_velocity][0] != kind:
        return
    stated = unit_in(name)
    if near != 1.0:
        why += f", slope {slope:.3g}"
    both = stated or (unit_in(position) and near == 1.0 and f"{unit_in(position)}/s")
    unit = of_velocity or (both if both in UNITS else None)
    found[channel.name] = Match(
        Column(name, _unless_own(unit, channel), -1 if slope < 0 else 1), why + ")"
    )
    own = joint.column
    if of_position and own.unit is None:
        unit = _unless_own(of_position, channel, "/s")
        found[channel.name.removesuffix(".velocity")] = Match(
            Column(own.column, unit), f"{joint.why}; {slope:.3g} times its rate"
        )


def _stated_unit(channel: Channel, name: str, why: str) -> Match:
    """A column in the unit that its name states, if the channel can be in it."""
    unit = unit_in(name)
    known = unit in UNITS and channel.unit in UNITS
    alike = known and UNITS[str(unit)][0] == UNITS[channel.unit][0]
    return Match(Column(name, _unless_own(unit, channel) if alike else None), why)


def _unless_own(unit: str | None, channel: Channel, rate: str = "") -> str | None:
    return None if unit is None or f"{unit}{rate}" == channel.unit else unit


def _unmatched(
    what: str,
    channels: Sequence[Channel],
    columns: Mapping[str, Values],
    where: str,
) -> InputError:
    names = ", ".join(c.name for c in channels)
    held = " ".join(f"{c.name}=0.0" for c in channels)
    either = f", say --constant {held} if held there," if what == "input" else ""
    got = ", ".join(columns)[:160] or "no other column"
    return error(
        "no_columns_found",
        where=where,
        got=got,
        what=what,
        names=names,
        first=channels[0].name,
        either=either,
    )
