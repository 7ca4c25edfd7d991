"""Export: draws of an identified machine, for a trainer that uses many machines.

Row ``i`` of all ``draws/NAME`` is one machine, in physical units; of a MuJoCo model it
is also the file ``variant_00i.xml``. Draws are as wide as the report's intervals.
"""

from pathlib import Path
from typing import Any

import jax

from sim2gp.commands.identification import Identification, Width, posterior_entries
from sim2gp.robot.export import write_model
from sim2gp.runs import Progress
from sim2gp.systems import one_variant


def export(
    found: Identification,
    out: Path | str,
    *,
    draws: int = 100,
    seed: int = 0,
    configuration: str | None = None,
    posterior: Width = "corrected",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write ``draws`` of the posterior that is asked for; returns the summary.

    Raises `InputError` E152 for a machine in several configurations and none named.
    """
    known = found.posterior if posterior == "corrected" else found.plain
    system, own = one_variant(found.machine, known, configuration)
    (progress or Progress()).say(
        f"drawing {draws} machines from the {posterior} posterior"
    )
    about = {"run": found.name, **posterior_entries(found.summary, posterior)}
    key = jax.random.key(seed)
    summary = write_model(own, Path(out), system, draws=draws, key=key, about=about)
    return summary | {"headline": f"{draws} machines as arrays and files: {out}"}
