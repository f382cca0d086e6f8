"""What is moved or added in a scene: the same place at a later time (`moved`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsparc.base.errors import list_first, suggest_name
from gsparc.base.instantiate import from_settings
from gsparc.base.limits import MOST_NAMED, Checked, Limit, finite_array, or_null, setting
from gsparc.data.walls import BOXES
from gsparc.simulate.scenes.solid import Solid, box

PLACE = Limit("three finite numbers [m]", lambda value: finite_array(value).shape == (3,))


@dataclass(frozen=True)
class Move(Checked):
    """One change: an object that is moved, or a box that is new.

    Attributes:
        name: of an object of the scene, or how names of its parts begin; None: a box is new.
        by_m: (3,) how far it is moved along x, y, z [m].
        box_m: [[x, y, z], [x, y, z]] lower and upper corner of a new box [m].
        material: of the new box, an ITU-R P.2040 name.
    """

    name: str | None = None
    by_m: Sequence[float] | None = setting(None, or_null(PLACE))
    box_m: Sequence[Any] | None = None
    material: str = "concrete"

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.name is None) != (self.by_m is None) or (self.name is None) == (
            self.box_m is None
        ):
            raise ValueError(
                "moved: say name and by_m of what is there, or box_m of what is new, of each"
            )
        if self.box_m is not None:
            BOXES.check("moved.box_m", [self.box_m])


def read_moves(moved: Sequence[Mapping[str, Any]]) -> list[Move]:
    """Return settings as moves; `ValueError` where one cannot be."""
    return [from_settings(Move, move, "moved") for move in moved]


def move_solids(solids: Sequence[Solid], moves: Sequence[Move]) -> tuple[list[Solid], list[Solid]]:
    """Return all objects of a scene after moves, and those of them that were moved or are new.

    >>> cabinet = box("cabinet", "metal", (0, 0, 0), (1, 1, 2))
    >>> _, (moved,) = move_solids([cabinet], [Move("cabinet", by_m=(2, 0, 0))])
    >>> moved.keep_out.tolist()
    [[2.0, 0.0, 0.0], [3.0, 1.0, 2.0]]

    Raises:
        ValueError: no object has such a name.
    """
    result, changed = list(solids), list[int]()
    for number, move in enumerate(moves):
        if move.name is None:
            result.append(box(f"new_{number}", move.material, *np.array(move.box_m, float)))
            changed.append(len(result) - 1)
            continue
        matches = [k for k, solid in enumerate(result) if solid.name.startswith(move.name)]
        if not matches:
            names = [solid.name for solid in solids]
            hint = suggest_name(move.name, names) or f"; there are {list_first(names, MOST_NAMED)}"
            raise ValueError(f"moved: no object's name begins with {move.name!r}{hint}")
        for k in matches:
            there, by = result[k].keep_out, np.array(move.by_m, float)
            keep_out = None if there is None else there + by
            result[k] = replace(result[k], vertices=result[k].vertices + by, keep_out=keep_out)
        changed += matches
    return result, [result[k] for k in dict.fromkeys(changed)]
