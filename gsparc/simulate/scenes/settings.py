"""The settings of the config group `scene`, and objects of it that are moved or added."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, replace
from typing import Any

import numpy as np

from gsparc.base import limits
from gsparc.base.errors import list_first, suggest_name
from gsparc.base.instantiate import from_settings
from gsparc.base.limits import (
    MOST_NAMED,
    POSITIVE,
    Checked,
    Limit,
    choice,
    finite_array,
    or_null,
    setting,
    whole,
)
from gsparc.data.walls import BOXES
from gsparc.simulate.scenes.conference import conference_room
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


BUILDERS = {"conference_room": conference_room}
SOURCES = ("builder", "builtin", "xml", "file", "room")
SEVERAL = limits.Limit("a list of one transmitter or more", bool)
MIN_RECEIVERS = 20


@dataclass(frozen=True)
class Layout(Checked):
    """The settings `scene.receivers`.

    Attributes:
        kind: `area` (drawn at random), `grid`, `streets` (of a map) or `file`.
        spacing_m: of a grid, and along streets [m].
        file: a table with x, y and z, or latitude, longitude and height, and perhaps `time_s`.
        inside: places in or on something that stands there are left out (`drop`) or an error
            (`refuse`); None: an error out of a file, else left out.
    """

    kind: str = setting("area", choice("area", "grid", "streets", "file"))
    spacing_m: float = setting(5.0, POSITIVE)
    file: str | None = None
    inside: str | None = setting(None, or_null(choice("drop", "refuse")))


@dataclass(frozen=True)
class SceneSettings(Checked):
    """One scene, chosen by exactly one of `SOURCES`.

    Attributes:
        name: of the dataset.
        num_receivers: how many, over an area.
        carrier_hz, bandwidth_hz, subcarriers: the band; subcarriers from end to end [Hz].
        transmitter_m: (3,) of the only one [m]; None, without `transmitters`: in the middle, which
            is said.
        transmitters: settings of `transmitters.Mast` each, in place of `transmitter_m`.
        area_m: [[x, y], [x, y]] lower and upper corner of where receivers are [m]; None: the
            middle, at most 400 m wide, which is said.
        height_m: lowest and highest height of a receiver [m].
        over: what heights count from: the world's `zero`, the `ground` (what stands there is kept
            off) or `roofs` (the highest surface, whatever it is).
        receivers: settings of `receivers.Layout`; None: drawn over the area.
        test_share: of the places held out for testing, drawn at random.
        builder: a procedure of ours (`conference_room`).
        builtin: a scene that comes with Sionna.
        xml: a Mitsuba or Sionna scene file.
        file: an extract of OpenStreetMap.
        room: of the shoebox engine: size_m, reflection (one number or six), boxes_m.
        open_sky: receivers stand where nothing is above them; None: where the scene has no ceiling.
        scattering: scattering coefficient of all materials without one; None: by material.
        seed: of the procedure and of the receivers.
        moved: settings of `moved.Move` each: the scene at a later time, with the same receivers but
            for those that something would now stand on.
    """

    name: str
    num_receivers: int
    carrier_hz: float = setting(MISSING, limits.POSITIVE)
    bandwidth_hz: float = setting(MISSING, limits.number(0))
    subcarriers: int = setting(MISSING, whole(1))
    transmitter_m: tuple[float, float, float] | None = setting(None, or_null(PLACE))
    transmitters: Sequence[Mapping[str, Any]] | None = setting(None, or_null(SEVERAL))
    area_m: tuple[tuple[float, float], tuple[float, float]] | None = None
    height_m: tuple[float, float] = (1.2, 1.8)
    over: str = setting("zero", choice("zero", "ground", "roofs"))
    receivers: Mapping[str, Any] | None = None
    test_share: float = setting(0.3, limits.SHARE)
    builder: str | None = setting(None, or_null(choice(*BUILDERS)))
    builtin: str | None = None
    xml: str | None = None
    file: str | None = None
    room: Mapping[str, Any] | None = None
    open_sky: bool | None = False
    scattering: float | None = None
    seed: int = 0
    moved: Sequence[Mapping[str, Any]] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        sources = [k for k in SOURCES if getattr(self, k) is not None]
        if len(sources) != 1:
            names = ", ".join(sources) or "none"
            raise ValueError(f"scene: give exactly one of {', '.join(SOURCES)}; got {names}")
        if self.transmitter_m is not None and self.transmitters is not None:
            raise ValueError(
                "scene: give transmitter_m or transmitters, not both (the other is null)"
            )
        if self.layout.kind == "area" and self.num_receivers < MIN_RECEIVERS:
            raise ValueError(
                f"scene.num_receivers={self.num_receivers}: expected at least {MIN_RECEIVERS}"
            )

    @property
    def layout(self) -> Layout:
        """Where receivers are."""
        return from_settings(Layout, self.receivers or {}, "scene.receivers")

    @property
    def frequency_hz(self) -> np.ndarray:
        """Subcarriers (K,) [Hz], about the carrier."""
        if self.subcarriers == 1:
            return np.array([self.carrier_hz])
        return self.carrier_hz + np.linspace(-0.5, 0.5, self.subcarriers) * self.bandwidth_hz


def from_config(config: Mapping[str, Any]) -> SceneSettings:
    """Return settings from the config group `scene`.

    Raises:
        ValueError: a setting that does not exist or cannot be.
    """
    return from_settings(SceneSettings, config, "scene")
