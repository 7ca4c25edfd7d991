"""What a joint fit says of each configuration of its machine, in a table."""

from collections.abc import Mapping, Sequence
from typing import Any

from sim2gp.data.logs import Log
from sim2gp.identification.forecasts.prediction import recording_names
from sim2gp.identification.words import quantity
from sim2gp.inference.parameters import Parameters
from sim2gp.systems import AbstractSystem, Variant


def configuration_entries(
    system: AbstractSystem,
    logs: Sequence[Log],
    parameters: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Summary keys of a machine in several configurations; none where it has one.

    ``parameters`` are the entries of all columns.
    """
    variants, table = system.variants, system.parameters
    if not variants:
        return {}
    sources = list(zip(recording_names(logs), (log.group for log in logs), strict=True))
    about = {
        c.name: {
            "recordings": len({source for source, group in sources if group == i}),
            "fixed": dict(c.fixed),
            "own": list(c.own),
        }
        for i, c in enumerate(variants)
    }
    differing = {x: None for c in variants for x in (*dict(c.fixed), *c.own)}
    rows = [["recordings", *(str(entry["recordings"]) for entry in about.values())]]
    for constant in differing:
        cells = [_configuration_cell(table, c, constant, parameters) for c in variants]
        rows.append([constant, *cells])
    listed = {
        "title": "The machine's configurations",
        "columns": ["", *about],
        "rows": rows,
        "note": "All other parameters are shared: one number for all recordings.",
    }
    return {"configurations": about, "tables": [listed]}


def _configuration_cell(
    table: Parameters,
    variant: Variant,
    constant: str,
    parameters: Mapping[str, Mapping[str, Any]],
) -> str:
    """A known value, the configuration's own column, or the shared one."""
    units = dict(zip(table.names, table.units, strict=True))
    column = variant.column(constant)
    if column in parameters:
        entry = parameters[column]
        text = f"{quantity(entry['mean'], units[column])} +- {entry['sd']:.2g}"
        return text if column != constant else f"{text} (shared)"
    known = dict(table.fixed) | dict(variant.fixed)
    return f"{known[constant]:.6g} (known)"
