"""Methods are told apart in every figure, with any colour vision."""

from collections import Counter

import numpy as np
from campaigns import compose

from gsparc.pictures.drawing import panels, spread_labels, style_of
from gsparc.pictures.from_above import annotate, map_panels, split_frame


def test_four_methods_of_a_comparison_shared_one_colour():
    methods = compose(config="compare").methods
    for kind in ("spectrum", "csi", "rssi"):
        names = [name for name, one in methods.items() if kind in one.get("kinds", [kind])]
        looks = {name: style_of(name) for name in names}
        assert len(set(looks.values())) == len(names), kind
        plain = [one for name, one in looks.items() if not name.endswith("_together")]
        assert max(Counter((one.colour, one.second) for one in plain).values()) == 1, kind


def test_numbers_of_a_tour_were_written_over_one_another():
    """And over its stops; what fits nowhere is left to the table."""
    figure, ((axis,),) = panels(4, 3)
    rng = np.random.default_rng(0)
    places = rng.uniform(0.2, 0.8, (40, 2))
    axis.set(xlim=(0, 1), ylim=(0, 1))
    for number, place in enumerate(places):
        annotate(axis, str(number), place)
    spread_labels(figure)
    shown = [text for text in axis.texts if text.get_visible()]
    boxes = [text.get_window_extent() for text in shown]
    assert len(shown) > 30
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    stops = axis.transData.transform(places)
    assert not any(box.contains(*stop) for box in boxes for stop in stops)


def test_two_patches_far_apart_left_an_empty_sheet():
    rng = np.random.default_rng(0)
    walked = rng.uniform(0, [400, 600], (300, 2))
    apart = rng.uniform([2000, 800], [2300, 900], (40, 2))
    frames = split_frame(np.concatenate([walked, apart]))
    assert len(frames) == 2 and frames[0][1][0] < 500 and frames[1][0][0] > 1900
    _, axes, room = map_panels(frames, 2, beside=3.0)
    assert axes.shape == (2, 2) and room is not None
    assert len(split_frame(walked)) == 1 and len(split_frame(walked[:1])) == 1
