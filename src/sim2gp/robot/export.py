"""What was learned, for machines and tools that know nothing of JAX.

Both are run directories: written at once or not at all, checked when they are read.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2gp import checks
from sim2gp.belief import AbstractBelief
from sim2gp.errors import error
from sim2gp.identification.identifiability.table import physical_moments
from sim2gp.inference.gaussian import Gaussian
from sim2gp.planning import Policy
from sim2gp.robot.format import FORMAT, check_shapes, check_values, header
from sim2gp.runs import new_run
from sim2gp.runs.archive import Declared
from sim2gp.runs.store import Writer
from sim2gp.systems import AbstractSystem, BlackBox, MuJoCo
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mujoco.load import compiled_all
from sim2gp.types import Key, in_float64, single

#: Files that one child process compiles, and models that are in memory at once.
TOGETHER = 32


def export_policy(policy: Policy, out: Path | str, system: AbstractSystem) -> None:
    """Write a trained policy for `load_policy`; ``system`` names its channels.

    Raises ValueError where the policy sees another number of states, `InputError` as
    `load_policy` does for what it would refuse, such as weights that are not finite.
    """
    if policy.observe.scale.size != len(system.states):
        seen, known = policy.observe.scale.size, len(system.states)
        raise ValueError(f"the policy sees {seen} states, the system has {known}")
    layers = policy.actor.weights, policy.actor.biases
    arrays: dict[str, Any] = {
        f"{name}/{i}": x
        for name, each in zip(("weights", "biases"), layers, strict=True)
        for i, x in enumerate(each)
    }
    # An angle is seen by its sine and cosine; its scale has no effect, and may be inf.
    angle, scale = policy.observe.angle, np.array(policy.observe.scale)
    if angle is not None:
        scale[angle] = 1.0
    arrays |= {"scale": scale, "low": policy.box.low, "high": policy.box.high}
    about = {
        "format": FORMAT,
        "layers": len(policy.actor.weights),
        "angle": angle,
        **_channel_entries(system),
    }
    plain = {name: np.asarray(x, np.float32) for name, x in arrays.items()}
    summary = {"title": "A trained policy", "policy": about}
    # As it will be read: nothing is written that a robot refuses.
    declared = {name: Declared(x.shape, x.dtype) for name, x in plain.items()}
    check_shapes(header(summary, str(out)), declared, str(out))
    check_values(plain, str(out))
    with new_run(out, "export policy") as writer:
        writer.write_arrays("arrays.npz", plain)
        writer.write_summary(summary)


def export_model(
    belief: AbstractBelief,
    out: Path | str,
    system: AbstractSystem,
    *,
    dt: float,
    draws: int,
    key: Key,
    compiled: bool = False,
) -> None:
    """Write a belief's parameters, correlated draws of them, and perhaps its mean step.

    ``arrays.npz`` holds ``draws/NAME``, in physical units: row ``i`` of all of them is
    one machine, for a trainer that randomises its simulator; of a MuJoCo model with a
    file, ``variant_000.xml`` and so on are those machines (of a URDF, as MJCF).
    ``compiled`` adds ``step.jax``, the mean step ``(s, a) -> s'`` over ``dt`` seconds
    in float32, for `jax.export.deserialize`; whether another version of JAX reads it is
    JAX's word.
    Raises `InputError` E134 where the belief has no parameters, E135 where writing
    compiled code needs what is not installed, E148 for a period or a number of draws
    that cannot be.
    """
    checks.positive("export_model", dt=dt)
    checks.count("export_model", draws=draws)
    known = getattr(belief, "posterior", None)
    if known is None or known.mean.size != len(system.parameters):
        raise error("belief_without_constants", name=type(belief).__name__)
    code = _compiled(belief, system) if compiled else None
    about = {"dt": dt, "posterior": "belief"}
    write_model(known, out, system, draws=draws, key=key, about=about, code=code)


def write_model(
    posterior: Gaussian,
    out: Path | str,
    system: AbstractSystem,
    *,
    draws: int,
    key: Key,
    about: Mapping[str, Any],
    code: bytes | None = None,
) -> dict[str, Any]:
    """Write parameters and ``draws`` of a Gaussian over virtual values; the summary.

    ``about`` says what it is a posterior of. Files as `export_model` has them.
    """
    rows, central = _draw_constants(posterior, system, draws, key)
    table = system.parameters
    units = dict(zip(table.names, table.units, strict=True))
    mean, scale = np.asarray(posterior.mean), np.asarray(posterior.scale)
    known = physical_moments(table, mean, np.linalg.norm(scale, axis=1))["sd"]
    sds = dict(zip(table.names, known.tolist(), strict=True))
    constants = {
        name: {
            "unit": units.get(name),
            "map": central[name],
            "sd": sds.get(name),
        }
        for name in central
    }
    model = {
        "system": type(system).__name__,
        **about,
        "draws": draws,
        "constants": constants,
        **_channel_entries(system),
    }
    summary = {"title": "A learned simulator", "model": model}
    with new_run(out, "export model") as writer:
        named = {f"draws/{name}": value for name, value in rows.items()}
        writer.write_arrays("arrays.npz", named)
        _write_variants(writer, system, rows)
        if code is not None:
            writer.write_bytes("step.jax", code)
        writer.write_summary(summary)
    return summary


@in_float64
def _draw_constants(
    posterior: Gaussian, system: AbstractSystem, draws: int, key: Key
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Draws of every parameter by name, and the one at the posterior's mean."""
    table = system.parameters
    tt = jax.vmap(posterior.sample)(jax.random.split(key, draws))
    rows = jax.vmap(table.values)(tt)
    central = table.values(posterior.mean)
    return (
        {name: np.broadcast_to(np.asarray(x), (draws,)) for name, x in rows.items()},
        {name: float(x) for name, x in central.items()},
    )


def _write_variants(
    writer: Writer, system: AbstractSystem, rows: dict[str, np.ndarray]
) -> None:
    """Of a MuJoCo model, its file with each draw's parameters (E170)."""
    model = plant_of(system)
    if not isinstance(model, MuJoCo) or model.source is None:
        return
    file, draws = model.file(mjcf=True), len(next(iter(rows.values())))
    for start in range(0, draws, TOGETHER):
        made = []
        for i in range(start, min(start + TOGETHER, draws)):
            values = model.by_path({name: float(x[i]) for name, x in rows.items()})
            main, edited = f"variant_{i:03d}{file.suffix}", file.edited(values)
            made.append((main, edited))
            # Relative paths from here are those from the run's final folder.
            for _, name, text in file.texts(edited, main, writer.folder):
                writer.write_bytes(name, text)
        found = compiled_all([writer.folder / name for name, _ in made])
        for (_, edited), each in zip(made, found, strict=True):
            file.check(edited, each)


def _compiled(belief: AbstractBelief, system: AbstractSystem) -> bytes:
    from jax import export

    if isinstance(plant_of(system), MuJoCo | BlackBox):
        raise error("simulator_on_host", got="a simulator that runs on the host")
    step = single(belief.point())
    shapes = [
        jax.ShapeDtypeStruct((len(each),), jnp.float32)
        for each in (system.states, system.actions)
    ]
    exported = export.export(jax.jit(lambda s, a: step(s, a)))(*shapes)
    try:
        return bytes(exported.serialize())
    except ImportError as caught:
        raise error("no_flatbuffers", got=str(caught)) from caught


def _channel_entries(system: AbstractSystem) -> dict[str, Any]:
    """Names in the order of the arrays, and the unit of each."""
    states, actions = system.states, system.actions
    return {
        "states": [channel.name for channel in states],
        "actions": [channel.name for channel in actions],
        "units": {channel.name: channel.unit for channel in (*states, *actions)},
    }
