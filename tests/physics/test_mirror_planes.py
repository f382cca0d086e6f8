import pytest
import torch

from gsparc.models.image_sources.reflection_orders import (
    find_orthogonal_walls,
    find_walls,
    reassign_to_walls,
)
from gsparc.models.image_sources.scene import SourceScene
from gsparc.physics.mirror_planes import all_sequences, bisector, images, reflect

WALLS = torch.tensor(
    [[1.0, 0, 0, 0], [2.0, 0, 0, 4.0], [0, 1, 0, 0], [0, 1, 0, 3.0]], dtype=torch.float64
)  # the second normal is not of unit length, and its plane is x = 4
TX = torch.tensor([0.6, 0.8, 1.9], dtype=torch.float64)


def test_mirror_twice_is_the_point_itself():
    torch.testing.assert_close(reflect(reflect(TX, WALLS), WALLS), TX.expand(4, 3))


def test_bisector_mirrors_one_point_into_the_other():
    other = torch.tensor([-3.0, 2.0, 0.5], dtype=torch.float64)
    torch.testing.assert_close(reflect(TX, bisector(TX, other)), other)


def test_sequences_are_mirrors_one_after_the_other():
    place = images(TX, WALLS, [(), (1,), (1, 0), (2, 3, 1)])
    by_hand = [TX, reflect(TX, WALLS[1]), reflect(reflect(TX, WALLS[1]), WALLS[0])]
    by_hand.append(reflect(reflect(reflect(TX, WALLS[2]), WALLS[3]), WALLS[1]))
    torch.testing.assert_close(place, torch.stack(by_hand))
    assert place[1].tolist() == pytest.approx([8 - 0.6, 0.8, 1.9])


def test_walls_are_found_by_the_sources_they_explain():
    sequences = [(), *all_sequences([0, 1, 2, 3], 2)]
    sources = images(TX, WALLS, sequences)
    sources = sources + 0.002 * torch.randn(
        sources.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    walls = find_walls(sources)
    assert walls is not None
    probe = torch.tensor([1.1, 0.3, 0.7], dtype=torch.float64)
    reached = torch.cdist(reflect(probe, WALLS), reflect(probe, walls)).amin(1)
    assert reached.max() < 0.05


def test_two_sources_make_no_wall():
    assert find_walls(torch.stack([TX, reflect(TX, WALLS[0])])) is None


def test_walls_of_a_box_are_told_from_sources_spelled_badly():
    walls = torch.tensor(
        [[1.0, 0, 0, 4], [0, 1, 0, 0], [0, 1, 0, 3], [0, 0, 1, 2.5]], dtype=torch.float64
    )
    transmitter = torch.tensor([0.0, 0.8, 1.9], dtype=torch.float64)
    sequences = ((), (0,), (1,), (2,), (3,), (0, 3), (1, 3), (0, 1))
    good = SourceScene(transmitter, walls, sequences, torch.zeros(len(sequences)), 0.0)
    # the far wall's images hang on tilted planes of their own
    tilted = bisector(good.sources[3].expand(2, 3), good.sources[[1, 5]])
    planes = torch.cat([walls[1:], tilted])
    bad = SourceScene(
        transmitter, planes, ((), (0,), (1,), (2,), (1, 3), (1, 4), (0, 2)), torch.zeros(7), 0.0
    )
    found = find_orthogonal_walls(bad)
    assert found is not None
    told = {(int(p[:3].abs().argmax()), round(float((p[3] * p[:3].sum()).abs()), 2)) for p in found}
    assert told == {(0, 4.0), (1, 0.0), (1, 3.0), (2, 2.5)}
    assert len(reassign_to_walls(bad, found).planes) == 4
