"""The paper's conference room, 14 x 10 x 4 m, built by a seeded procedure.

The paper names its size, tables, chairs, glass partitions, irregular walls and a transmitter near
the ceiling; where they stand is ours.
"""

from __future__ import annotations

import numpy as np

from gsparc.base.files import read_shipped_table
from gsparc.simulate.scenes.solid import Solid, box, sheet

SIZE = np.array([14.0, 10.0, 4.0])
WALLS = (  # material along the four walls, in panels from corner to corner
    ("concrete", "plasterboard", "brick", "plasterboard"),
    ("brick", "wood", "brick"),
    ("plasterboard", "concrete", "glass", "concrete"),
    ("plasterboard", "brick", "plasterboard"),
)


def conference_room(seed: int = 0) -> list[Solid]:
    """Return all objects of the room; the seed moves furniture and wall panels by decimetres."""
    rng = np.random.default_rng(seed)
    shell, chairs, shift = _shell(rng), _chairs(rng), rng.uniform(-0.2, 0.2)
    return [*shell, *_listed("fixed"), *chairs, *_listed("shifted", shift)]


def _shell(rng: np.random.Generator) -> list[Solid]:
    """Floor, ceiling, and walls whose panels stand out by up to a decimetre;
    closed behind the panels.
    """
    x, y, z = SIZE
    solids = [
        sheet("floor", "concrete", (0, 0, 0), (x, 0, 0), (0, y, 0)),
        sheet("ceiling", "ceiling_board", (0, 0, z), (0, y, 0), (x, 0, 0)),
    ]
    corners = np.array([[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0]], dtype=float)
    for w, materials in enumerate(WALLS):
        start, end = corners[w], corners[(w + 1) % 4]
        along = end - start
        inwards = np.cross([0, 0, 1], along / np.linalg.norm(along))
        cuts = np.linspace(0, 1, len(materials) + 1)
        cuts[1:-1] += rng.uniform(-0.05, 0.05, len(materials) - 1)
        # Every second panel stands out: the paper's walls are irregular.
        depths = [0.0 if i % 2 else float(rng.uniform(0.04, 0.12)) for i in range(len(materials))]
        for i, material in enumerate(materials):
            base = start + cuts[i] * along + depths[i] * inwards
            name = f"wall{w}_{i}"
            solids.append(sheet(name, material, base, (cuts[i + 1] - cuts[i]) * along, (0, 0, z)))
            # The gap between panels of different depth is closed.
            if i and depths[i] != depths[i - 1]:
                edge = start + cuts[i] * along + depths[i - 1] * inwards
                step = (depths[i] - depths[i - 1]) * inwards
                solids.append(sheet(f"{name}_step", material, edge, step, (0, 0, z)))
    return solids


def _listed(group: str, shift: float = 0.0) -> list[Solid]:
    """Sheets (a corner, two sides) and boxes (two corners) of conference.csv;
    some moved along an axis.
    """
    solids = []
    for row in read_shipped_table(__package__, "conference.csv"):
        metres = np.array(row["metres"].split(), dtype=float).reshape(-1, 3)
        if row["moves"]:
            metres[:, "xy".index(row["moves"])] += shift
        shape = box if len(metres) == 2 else sheet
        solids += [shape(row["name"], row["material"], *metres)] * (row["group"] == group)
    return solids


def _chairs(rng: np.random.Generator) -> list[Solid]:
    """Two rows of six at the long table, and one at each desk."""
    solids = []
    places = [(4.9 + 0.8 * i, 5.0 + side * 1.15, side) for i in range(6) for side in (-1, 1)]
    places += [(2.2, 7.5, -1), (12.0, 7.4, -1)]
    for i, (x, y, side) in enumerate(places):
        x, y = x + rng.uniform(-0.1, 0.1), y + rng.uniform(-0.12, 0.12)
        turn = float(rng.uniform(-0.4, 0.4))
        low, high = (x - 0.22, y - 0.22, 0.42), (x + 0.22, y + 0.22, 0.46)
        solids.append(box(f"chair{i}_seat", "plywood", low, high, turn))
        back = y + side * 0.24
        low, high = (x - 0.21, back - 0.02, 0.47), (x + 0.21, back + 0.02, 0.95)
        solids.append(box(f"chair{i}_back", "plywood", low, high, turn))
    return solids
