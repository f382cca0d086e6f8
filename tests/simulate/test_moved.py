"""The same scene at a later time: the same receivers, and something that was moved or is new."""

import numpy as np
import pytest
from refusals import refused

from gsparc.simulate.effects import Effects
from gsparc.simulate.raytracer import Sampling
from gsparc.simulate.scenes.build import build_survey
from gsparc.simulate.scenes.conference import conference_room
from gsparc.simulate.scenes.settings import Move, SceneSettings, move_solids

FACTS = {
    "name": "room",
    "num_receivers": 200,
    "carrier_hz": 2.4e9,
    "bandwidth_hz": 0.0,
    "subcarriers": 1,
    "transmitter_m": [1.0, 2.5, 2.6],
    "area_m": [[0.2, 0.2], [9.8, 4.8]],
    "room": {"size_m": [10.0, 5.0, 3.0], "boxes_m": [[[4.0, 1.0, 0.0], [5.0, 2.0, 2.6]]]},
}


def test_receivers_stay_but_for_those_that_a_cabinet_now_stands_on():
    before, after = (
        build_survey(SceneSettings(**FACTS, moved=moved), Sampling())
        for moved in ([], [{"name": "box0", "by_m": [1.0, 2.0, 0.0]}])
    )
    on = ((before.places[:, :2] > [5, 3]) & (before.places[:, :2] < [6, 4])).all(1)
    assert 0 < on.sum() < 20 and np.array_equal(after.places, before.places[~on])
    power = [
        one.trace(np.arange(len(after)), Effects()).received_power() for one in (after, before)
    ]
    # Its shadow is elsewhere now.
    assert not np.allclose(*(np.log(p[: len(after)]) for p in power), atol=0.1)


def test_parts_move_by_the_beginning_of_their_name_and_boxes_are_new():
    room = conference_room()
    after, moved = move_solids(
        room, [Move("desk_a", (1.0, 0, 0)), Move(box_m=[[1, 1, 0], [2, 2, 2]])]
    )
    assert [one.name for one in moved] == ["desk_a", "desk_a_leg0", "desk_a_leg1", "new_1"]
    assert len(after) == len(room) + 1
    shift = after[[one.name for one in room].index("desk_a")].vertices - next(
        one.vertices for one in room if one.name == "desk_a"
    )
    assert np.allclose(shift, [1, 0, 0])
    refused(
        "no object's name begins with 'cupboard'", move_solids, room, [Move("cupboard", (1, 0, 0))]
    )


@pytest.mark.parametrize(
    "wrong", [{}, {"name": "box0"}, {"name": "a", "by_m": [1, 0, 0], "box_m": []}]
)
def test_a_move_is_of_what_is_there_or_new(wrong):
    refused("say name and by_m of what is there", Move, **wrong)
