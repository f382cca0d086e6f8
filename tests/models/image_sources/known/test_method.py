"""`init=scene`: against a search on few rows, without walls' ends, and through `train.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from campaigns import compose
from closed import fitted_to, read_back
from rooms import nmse, shoebox
from shoeboxes import as_arrays

from gsparc.commands.train import train
from gsparc.data.errors import DataError
from gsparc.data.own import write_own
from gsparc.data.splits import Fold
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
    context = FitContext(budget_s=60.0)
    method = CANDIDATES[name](InitSettings(name, searches=1, **init), True, context)
    return method, method.fit(data, Fold(np.sort(rows), rows[:0], rows[:0]), context)


def missed(field, data, rows: np.ndarray) -> float:
    batch = data.batch(rows)
    return nmse(field.predict(batch).mean.numpy(), data.targets(rows).numpy())


def test_known_walls_tell_all_from_few_rows(room):
    """A search on the same 60 rows misses most of them."""
    _, data, fold, file = room
    known, report = fitted("scene", data, fold.train[:60], file=str(file))
    missed_here = missed(known, data, fold.test)
    assert missed_here < 0.05
    assert known.terms[:2] == ("phase", "visibility") and known.count > 20
    assert any("occluding boxes" in note for note in report.notes)
    again = read_back(known)
    assert missed(again, data, fold.test) == pytest.approx(missed_here, rel=1e-3)


def test_without_visibility_every_image_is_seen_everywhere(room):
    _, data, fold, file = room
    settings = InitSettings("scene", file=str(file), order=1)
    field = CANDIDATES["scene"](settings, False, FitContext())
    fitted_to(field, data, fold.train[:40], budget_s=30.0)
    assert field.terms[0] == "phase" and "visibility" not in field.terms and field.count == 7


def walled(folder: Path, kind: str) -> list[str]:
    """Overrides of a short run over 60 rows of the room with known walls."""
    told, _, _ = shoebox(60, pillar=True, max_order=1)
    arrays = as_arrays(told)
    if kind == "rssi":
        power = 20 * np.log10(np.abs(arrays.pop("csi")[:, 0, 0]))
        arrays = {name: arrays[name] for name in ("rx_position", "tx_position")} | {"rssi_db": power}
    (folder / "room.yaml").write_text(ROOM, encoding="utf-8")
    write_own(folder / "own.npz", arrays)
    files = [f"dataset.file='{folder / 'own.npz'}'", f"init.file='{folder / 'room.yaml'}'"]
    return [
        "dataset=own", "init=scene", *files,
        "baselines=[mean]", "logger=none", "threads=1", "budget_s=10", "trainer.max_steps=10",
    ]  # fmt: skip


@pytest.mark.parametrize("kind", ["csi", "rssi"])
def test_a_run_says_where_it_started(kind, tmp_path):
    more = ["init.max_sources=12", "init.order=1"] if kind == "csi" else []
    facts, _ = train(compose(*walled(tmp_path, kind), *more), tmp_path / "run")
    assert "scene" in str(facts["model/init"]) and facts["time/init_s"] > 0
    assert facts["test/nmse"] < (0.2 if kind == "csi" else 1.0)


def test_what_walls_cannot_serve_is_one_line(tmp_path):
    run = walled(tmp_path, "csi")
    with pytest.raises(DataError, match=r"absent\.yaml: missing; expected a table of `walls`"):
        train(compose(*run, f"init.file={tmp_path / 'absent.yaml'}"), tmp_path / "a")
    with pytest.raises(ValueError, match=r"init=scene is not possible: model\.effects\.phase=false"):
        train(compose(*run, "model.effects.phase=false"), tmp_path / "b")
