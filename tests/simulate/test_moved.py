"""The same scene at a later time: the same receivers, and something that was moved or is new."""

import numpy as np
import pytest
from refusals import refused

from gsparc.simulate.scenes.conference import conference_room
from gsparc.simulate.scenes.settings import Move, move_solids


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
