"""`gsparc compare task=locate`: models that were kept say where their test rows were heard."""

from __future__ import annotations

import csv

import pytest
from campaigns import compose, spectra
from hydra import initialize_config_module

from gsparc.commands import compare_places
from gsparc.commands.train import train
from gsparc.evaluation.experiment.cells import Cell
from gsparc.evaluation.experiment.fitting import Filled

SETTINGS = {"fingerprints": {}, "splits": [], "against": ["nearest"], "calibrate": 0, "rows": 4}


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cells")
    file = spectra(folder / "own.npz", rows=60)
    for model in ("gp", "idw"):
        chosen = f"model={model}", "baselines=[]", "logger=none"
        train(compose("dataset=own", f"dataset.file='{file}'", *chosen), folder / model)
        (folder / model / "model.ckpt").rename(folder / model / "fold0.ckpt")
    cells = [Filled(Cell("own", "random", model, None, None), folder / model, {}) for model in ("gp", "idw")]
    return [*cells, Filled(Cell("own", "random", "gone", None, None), folder / "gone", {})]


def compared(filled, run_dir, kept, **more):
    run_dir.mkdir(exist_ok=True)
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        return compare_places.compare_places(filled, SETTINGS | more, kept, run_dir)


def test_models_with_a_variance_stand_beside_plain_methods(filled, tmp_path, caplog, monkeypatch):
    rows = compared(filled, tmp_path / "run", tmp_path)
    assert [row.method for row in rows] == ["gp", "nearest"] and rows[0].median_m < rows[1].median_m
    assert rows[0].held is not None and rows[1].held is None
    assert "own/random/idw is not located" in caplog.text
    with (tmp_path / "run" / "places.csv").open(newline="") as stream:
        assert [row["method"] for row in csv.DictReader(stream)] == ["gp", "nearest"]
    monkeypatch.setattr(compare_places, "locate", None)  # what is kept is not located again
    assert compared(filled[:1], tmp_path / "run", tmp_path) == rows


def test_without_a_variance_there_is_nothing_to_compare(filled, tmp_path):
    with pytest.raises(ValueError, match="task=locate: no cell keeps a model that states a variance"):
        compared(filled[1:], tmp_path / "run", tmp_path)


def test_fingerprints_are_split_as_is_said(tmp_path, monkeypatch):
    file, asked = tmp_path / "lib.npz", []
    file.write_bytes(b"levels")

    def located(config, folder):
        asked.append((config.dataset.name, config.dataset.split, config.dataset.file))
        return {
            "locate/median_m": 1.0,
            "locate/p90_m": 2.0,
            "locate/coverage": 0.9,
            "time/locate_ms_p50": 3.0,
        }

    monkeypatch.setattr(compare_places, "locate", located)
    chosen = {"fingerprints": {"lib": str(file)}, "splits": ["random", "blocks"]}
    rows = compared([], tmp_path / "run", tmp_path, **chosen)
    assert [(row.dataset, row.split, row.method) for row in rows] == [
        ("lib", "blocks", "field"), ("lib", "random", "field"),
    ]  # fmt: skip
    assert asked == [("fingerprints", split, str(file)) for split in ("random", "blocks")]
