"""Record the frozen figures again: ``python tests/frozen/record.py [part of a name]``.

Only for figures that are meant to move; say why in the commit.
"""

import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from frozen.cases import VALUES, every


def main(part: str = "") -> None:
    """Write the values of the cases whose name contains ``part``."""
    VALUES.mkdir(exist_ok=True)
    for name, case in every().items():
        if part in name:
            started = time.perf_counter()
            np.savez_compressed(VALUES / f"{name.replace('/', '_')}.npz", **case())
            jax.clear_caches()  # each compiled function takes several memory maps
            print(f"{name}: {time.perf_counter() - started:.1f} s", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:2])
