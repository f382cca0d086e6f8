"""`init=scene`: known walls from few rows, and without walls' ends."""

import numpy as np
import pytest
from closed import fitted_to, read_back
from rooms import nmse, shoebox

from gsparc.base.errors import DataError
from gsparc.data.splits import Fold
from gsparc.data.walls import read_walls
from gsparc.field.initial import InitSettings
from gsparc.models.mixture.candidates import CANDIDATES
from gsparc.training.context import FitContext

ROOM = "room: {size_m: [4.0, 3.0, 2.5], boxes_m: [[[1.6, 1.2, 0.0], [2.0, 1.6, 2.5]]]}"


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A room with a pillar, and the file of its walls."""
    file = tmp_path_factory.mktemp("scene") / "room.yaml"
    file.write_text(ROOM, encoding="utf-8")
    told, data, fold = shoebox(120, pillar=True)
    return told, data, fold, file


def fitted(name: str, data, rows: np.ndarray, **init):
    context = FitContext()
    method = CANDIDATES[name](InitSettings(name, searches=1, **init), True, context)
    return method, method.fit(data, Fold(np.sort(rows), rows[:0], rows[:0]), context)


def test_a_file_of_walls_that_is_not_there_is_named(tmp_path):
    with pytest.raises(DataError, match=r"absent\.yaml: missing; expected a table of `walls`"):
        read_walls(tmp_path / "absent.yaml")


def missed(field, data, rows: np.ndarray) -> float:
    batch = data.batch(rows)
    return nmse(field.predict(batch).mean.numpy(), data.targets(rows).numpy())


@pytest.mark.slow
def test_known_walls_tell_all_from_few_rows(room):
    """A search on the same 60 rows misses most of them."""
    _, data, fold, file = room
    known, report = fitted("scene", data, fold.train[:60], file=str(file))
    missed_here = missed(known, data, fold.test)
    assert missed_here < 0.05
    assert known.terms[:2] == ("phase", "visibility") and known.count_gaussians > 20
    assert any("occluding boxes" in note for note in report.notes)
    again = read_back(known)
    assert missed(again, data, fold.test) == pytest.approx(missed_here, rel=1e-3)


def test_without_visibility_every_image_is_seen_everywhere(room):
    _, data, fold, file = room
    settings = InitSettings("scene", file=str(file), order=1)
    field = CANDIDATES["scene"](settings, False, FitContext())
    fitted_to(field, data, fold.train[:40])
    assert (
        field.terms[0] == "phase" and "visibility" not in field.terms and field.count_gaussians == 7
    )
