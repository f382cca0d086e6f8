"""Single places are answered by one thread, whatever torch has; what is rendered keeps them all."""

from __future__ import annotations

import pytest
import torch

from gsparc.models.method import suited_threads
from gsparc.models.registry import method_class


@pytest.fixture
def two():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize(("name", "places", "inside"), [("gp", 1, 1), ("gp", 2, 2), ("nerf2", 1, 2)])
def test_threads_of_a_query(two, name, places, inside):
    with pytest.raises(ZeroDivisionError), suited_threads(method_class(name)(), places):
        assert torch.get_num_threads() == inside
        raise ZeroDivisionError
    assert torch.get_num_threads() == 2  # also after an error
