"""Model files of others: each opens and steps as C MuJoCo, or is refused by name.

    python benchmarks/model_files.py [--out FILE]

Every MJCF and URDF file of dm_control, gymnasium and mjlab, wherever they are installed
(`pip install --no-deps dm_control mjlab` is enough). A file that opens is compared over
five steps from three random states with MuJoCo's own `mj_step` on a model that MuJoCo
itself has read, and is differentiated in all its constants, states and inputs. A file
that is refused must be so in one line with a code and the element. Anything else is a
third case.
"""

import argparse
import json
import sys
import warnings
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2gp.errors import InputError, Sim2GPWarning
from sim2gp.systems import MuJoCo
from sim2gp.types import in_float64

PACKAGES = ("dm_control", "gymnasium", "mjlab")
POINTS, STEPS = 3, 5
SAME = 1e-10  # relative and absolute
RESULTS = Path(__file__).resolve().parents[1] / "results" / "model_files.json"


def files(packages: tuple[str, ...] = PACKAGES) -> dict[str, Path]:
    """All files that look like models, by their place in the installed packages."""
    found = {}
    for name in packages:
        spec = find_spec(name)
        for folder in [] if spec is None else spec.submodule_search_locations or []:
            root = Path(folder)
            paths = [p for kind in ("xml", "urdf") for p in root.rglob(f"*.{kind}")]
            found |= {p.relative_to(root.parent).as_posix(): p for p in sorted(paths)}
    return found


def row(name: str, path: Path) -> dict[str, Any]:
    """What becomes of one file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Sim2GPWarning)
            plant = MuJoCo(path)
    except InputError as error:
        return {
            "file": name,
            "opens": False,
            "code": error.code,
            "what": error.what,
            # Not where the packages happen to be installed.
            "element": str(error.got).replace(str(path).removesuffix(name), ""),
            "lines": len(str(error).splitlines()),
        }
    error, finite = compared(plant, path)
    return {
        "file": name,
        "opens": True,
        "states": len(plant.states),
        "inputs": len(plant.actions),
        "constants": len(plant.parameters.names),
        "step_error": error,
        "derivative_finite": finite,
    }


@in_float64
def compared(plant: MuJoCo, path: Path) -> tuple[float, bool]:
    """Largest error of steps, of one plus their size, and whether slopes are finite."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    nominal = plant.parameters.nominal()
    theta = plant.record({k: jnp.asarray(v) for k, v in nominal.items()})
    h = jnp.asarray(STEPS * model.opt.timestep)
    slopes = jax.jit(jax.jacfwd(plant.flow, argnums=(0, 1, 2)))
    worst, finite = 0.0, True
    for s, a, expected in _rollouts(model):
        found = np.asarray(plant.flow(theta, jnp.asarray(s), jnp.asarray(a), h))
        error = np.abs(found - expected) / (1.0 + np.abs(expected))
        worst = max(worst, float(np.max(error)))  # NaN is no error of zero
        worst = worst if np.isfinite(found).all() else np.inf
        J = slopes(theta, jnp.asarray(s), jnp.asarray(a), h)
        finite &= all(bool(jnp.isfinite(x).all()) for x in J)
    return worst, finite


def _rollouts(model: Any) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Random states and inputs, and the state after some steps of C MuJoCo."""
    import mujoco

    rng = np.random.default_rng(0)
    for _ in range(POINTS):
        data = mujoco.MjData(model)
        data.qpos += 0.1 * rng.standard_normal(model.nq)
        data.qvel[:] = 0.3 * rng.standard_normal(model.nv)
        data.act[:] = rng.uniform(0.0, 0.5, model.na)
        data.ctrl[:] = rng.uniform(-0.5, 0.5, model.nu)
        limited = model.actuator_ctrllimited.astype(bool)
        low, high = model.actuator_ctrlrange[limited].T
        data.ctrl[limited] = np.clip(data.ctrl[limited], low, high)
        s, a = np.concatenate([data.qpos, data.qvel, data.act]), data.ctrl.copy()
        for _ in range(STEPS):
            mujoco.mj_step(model, data)
        yield s, a, np.concatenate([data.qpos, data.qvel, data.act])


def holds(found: dict[str, Any]) -> bool:
    """Whether a file is one of the two cases."""
    if found["opens"]:
        return bool(found["step_error"] <= SAME and found["derivative_finite"])
    return bool(found["code"] and found["element"]) and found["lines"] == 1


def main() -> None:
    """Write the table; say what is no case of the two."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=RESULTS)
    out = parser.parse_args().out
    every = files()
    missing = [p for p in PACKAGES if not any(f.startswith(p + "/") for f in every)]
    rows = []
    for name, path in every.items():
        rows.append(row(name, path))
        sys.stdout.write(f"{json.dumps(rows[-1])}\n")
    wrong = [r["file"] for r in rows if not holds(r)]
    count = {
        "files": len(rows),
        "open": sum(r["opens"] for r in rows),
        "refused": sum(not r["opens"] for r in rows),
        "third_case": len(wrong),
    }
    lines = ",\n".join(json.dumps(each) for each in rows)
    out.write_text(f'{{"count": {json.dumps(count)},\n"rows": [\n{lines}\n]}}\n')
    sys.stdout.write(f"{count}; not installed: {missing}; third case: {wrong}\n")


if __name__ == "__main__":
    main()
