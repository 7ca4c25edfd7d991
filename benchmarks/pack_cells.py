"""Packs the cells of finished studies: NAME.cells becomes NAME.cells.jsonl.gz.

    python benchmarks/pack_cells.py results

Studies go on from a pack as from a folder: new cells are put into a folder again.
"""

import sys
from pathlib import Path

from sim2gp.runs.packed_cells import pack


def main(where: Path) -> None:
    """Pack each folder of cells below ``where``."""
    for folder in sorted(where.glob("**/*.cells")):
        if any(x.is_file() and x.suffix != ".json" for x in folder.rglob("*")):
            print(f"{folder}: left, its cells have other files")
            continue
        count = len(list(folder.glob("*.json")))
        target = pack(folder)
        print(f"{target}: {count} cells, {target.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
