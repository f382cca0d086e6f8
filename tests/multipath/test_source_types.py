import pytest
import torch

from gsparc.multipath.source_types import SourceKind, path_length

TX = torch.tensor([0.0, -3.0, 0.5], dtype=torch.float64)
RX = torch.tensor([[2.0, 4.0, 1.5], [1.0, 2.0, -1.0]], dtype=torch.float64)
EDGE = torch.tensor([[0.5, 0.2, 0.0]], dtype=torch.float64)
UP = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.mark.parametrize("kind", [SourceKind.IMAGE, SourceKind.SCATTERER])
def test_points_are_straight_lines(kind):
    torch.testing.assert_close(path_length(kind, RX, EDGE, TX), torch.cdist(RX, EDGE), rtol=1e-6, atol=1e-6)


def test_an_edge_takes_the_shortest_way_over_it():
    along = torch.linspace(-5, 5, 20001, dtype=torch.float64)
    points = EDGE + along[:, None] * UP
    detours = torch.cdist(TX[None], points) + torch.cdist(RX, points)  # Fermat: the least of all detours
    length = path_length(SourceKind.EDGE, RX, EDGE, TX, UP)
    torch.testing.assert_close(length[:, 0], detours.amin(1), rtol=1e-6, atol=1e-6)


def test_an_edge_needs_its_direction():
    with pytest.raises(ValueError, match="direction"):
        path_length(SourceKind.EDGE, RX, EDGE, TX)
