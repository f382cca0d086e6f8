"""What a closed-form field of channels may consist of."""

from __future__ import annotations

from dataclasses import dataclass

from gsparc.data.limits import POSITIVE, Checked, number, setting, switch, whole


@dataclass(frozen=True)
class ChannelSettings(Checked):
    """Terms beside the isotropic diffuse field, and what they are learned on.

    Attributes:
        constant: what does not depend on the place (leakage); `auto`: where left-out places gain.
        direct: the wave of the static end, with a fixed gain and one that varies over places; likewise.
        directions: unequal powers of the diffuse field's directions; likewise.
        correlated: noise that is correlated over the order of rows; likewise.
        offset: look for an offset of the static end's place.
        angles: directions of the diffuse field, of a half sphere where all places are in one plane.
        concentration: of each direction, that of a von Mises-Fisher density.
        shrinkage: of directions' powers towards their mean, in rows of the inverse Gamma prior.
        rows: measurements that powers are learned on at most.
        columns: static ends, antennas or bands of tones that terms are decided on at most.
        ends: of several static ends, those that powers are learned on in the end.
        tied: directions whose powers depend on the angle to the end as well, of a half sphere where flat.
        narrow: concentration of each of these.
        knots: in that angle.
        mirrors: planes that several static ends share, at most; 0 for none.
    """

    constant: bool | str = setting("auto", switch("auto"))
    direct: bool | str = setting("auto", switch("auto"))
    directions: bool | str = setting("auto", switch("auto"))
    correlated: bool | str = setting("auto", switch("auto"))
    offset: bool = setting(True, switch())
    angles: int = setting(24, whole(4, 200))
    concentration: float = setting(8.0, POSITIVE)
    shrinkage: float = setting(0.5, number(0))
    rows: int = setting(400, whole(8))
    columns: int = setting(8, whole(1))
    ends: int = setting(64, whole(1))
    tied: int = setting(64, whole(4, 500))
    narrow: float = setting(16.0, POSITIVE)
    knots: int = setting(9, whole(2, 100))
    mirrors: int = setting(8, whole(0, 32))
