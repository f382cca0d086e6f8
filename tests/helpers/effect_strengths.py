"""How often a column is named that says who transmitted, over how much it says; 200 rows, 2 dB of noise.

PYTHONPATH=tests/helpers python tests/helpers/effect_strengths.py 20    # tables of each strength
"""

import sys

import numpy as np
from level_fields import fields

from gsparc.data.checks.column_effects import LevelsAtPlaces, find_effects

ROWS = 200
STRENGTHS = {"device": (1, 2, 3, 5, 10), "transmitters": (3, 10, 30), "relayed": (0.05, 0.1, 0.2, 0.5)}


def is_named(what: str, strength: float, seed: int) -> bool:
    """Whether the only column that says anything is named, and no other is."""
    rng = np.random.default_rng(seed)
    place, every = fields(seed, int(strength) if what == "transmitters" else 1)
    place, level = place[:ROWS], every[:ROWS, 0]
    if what == "transmitters":
        code = rng.integers(0, int(strength), ROWS)
        level = every[np.arange(ROWS), code]
    elif what == "device":
        code = rng.integers(0, 2, ROWS)
        level = level + strength * code
    else:
        code = (rng.uniform(size=ROWS) < strength).astype(int)
        level = np.where(code, rng.normal(-70, 6, ROWS), level)  # of relays elsewhere
    level = np.round(level + rng.normal(0, 2, ROWS))
    columns = {"column": code.astype(str), "port": rng.integers(0, 8, ROWS).astype(str)}
    found = find_effects(LevelsAtPlaces(place, np.zeros(ROWS, int), level), np.arange(ROWS), columns)
    return [one.head for one in found] == ["column"]


def main(count: int) -> None:
    """Write the share of so many tables of each strength."""
    for what, strengths in STRENGTHS.items():
        shares = (np.mean([is_named(what, one, seed) for seed in range(count)]) for one in strengths)
        shown = [f"{one:g} {share:.0%}" for one, share in zip(strengths, shares, strict=True)]
        sys.stdout.write(f"{what}: {', '.join(shown)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]))
