"""What a closed-form field of channels may consist of."""

from __future__ import annotations

from dataclasses import dataclass

from gsparc.data.limits import POSITIVE, Checked, setting, switch, whole


@dataclass(frozen=True)
class ChannelSettings(Checked):
    """Terms that are tried beside the isotropic diffuse field, and what they are learned on.

    Attributes:
        constant: what does not depend on the place (leakage).
        direct: the wave of the static end, with a fixed gain and one that varies over places.
        directions: unequal powers of the diffuse field's directions.
        correlated: noise that is correlated over the order of rows.
        angles: directions of the diffuse field, of a half sphere where all places are in one plane.
        rows: measurements that powers are learned on at most.
        tied: directions whose powers depend on the angle to the end as well, of a half sphere where flat.
        narrow: concentration of each of these.
        knots: in that angle.
        mirrors: planes that several static ends share, at most; 0 for none.
    """

    constant: bool = setting(True, switch())
    direct: bool = setting(True, switch())
    directions: bool = setting(True, switch())
    correlated: bool = setting(True, switch())
    angles: int = setting(24, whole(4, 200))
    rows: int = setting(400, whole(8))
    tied: int = setting(64, whole(4, 500))
    narrow: float = setting(16.0, POSITIVE)
    knots: int = setting(9, whole(2, 100))
    mirrors: int = setting(8, whole(0, 32))
