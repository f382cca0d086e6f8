"""The paper's conference room, 14 x 10 x 4 m, built by a seeded procedure.

The paper names its size, tables, chairs, glass partitions, irregular walls and a transmitter near the
ceiling; where they stand is ours.
"""

from __future__ import annotations

import numpy as np

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
    return [*_shell(rng), *_partitions(), *_tables(rng), *_furniture(rng)]


def _shell(rng: np.random.Generator) -> list[Solid]:
    """Floor, ceiling, and walls whose panels stand out by up to a decimetre; closed behind the panels."""
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


def _partitions() -> list[Solid]:
    """Glass: two sheets that cut a corner office off, open at a door, and a free-standing one; pillars."""
    return [
        sheet("glass_office_a", "glass", (9.6, 6.4, 0), (4.3, 0, 0), (0, 0, 2.8)),
        sheet("glass_office_b", "glass", (9.6, 7.5, 0), (0, 2.4, 0), (0, 0, 2.8)),
        sheet("glass_free", "glass", (3.2, 2.0, 0), (2.6, 0.5, 0), (0, 0, 2.2)),
        box("pillar_a", "concrete", (4.7, 6.6, 0), (5.2, 7.1, 4.0)),
        box("pillar_b", "concrete", (9.1, 3.0, 0), (9.6, 3.5, 4.0)),
    ]


def _tables(rng: np.random.Generator) -> list[Solid]:
    """A long table of the meeting with chairs around, and two desks."""
    solids = []
    tables = {
        "table_long": (6.9, 5.0, 4.8, 1.4),
        "desk_a": (2.2, 8.4, 1.8, 0.9),
        "desk_b": (12.0, 8.3, 1.8, 0.9),
    }
    for name, (x, y, length, width) in tables.items():
        a, b = length / 2, width / 2
        solids.append(box(name, "wood", (x - a, y - b, 0.70), (x + a, y + b, 0.74)))
        for i, foot in enumerate((x - (a - 0.35), x + (a - 0.35))):
            low, high = (foot - 0.06, y - (b - 0.15), 0.0), (foot + 0.06, y + (b - 0.15), 0.69)
            solids.append(box(f"{name}_leg{i}", "metal", low, high))
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


def _furniture(rng: np.random.Generator) -> list[Solid]:
    """A bookcase, two cabinets, a screen."""
    shift = rng.uniform(-0.2, 0.2)
    return [
        box("bookcase", "wood", (0.15, 2.0 + shift, 0), (0.55, 4.4 + shift, 2.1)),
        box("cabinet_a", "metal", (11.0, 0.15, 0), (12.6, 0.65, 1.3)),
        box("cabinet_b", "chipboard", (6.0 + shift, 9.3, 0), (8.2 + shift, 9.85, 1.6)),
        box("screen", "metal", (0.14, 5.6, 1.1), (0.2, 7.6, 2.3)),
    ]
