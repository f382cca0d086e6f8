"""`gsparc compare task=locate`: models that were kept say where their test rows were heard."""

import shutil

import pytest
import towns
from campaigns import spectra
from hydra import initialize_config_module

from gsparc.commands.locate import locate
from gsparc.evaluation.experiment.cells import Cell
from gsparc.evaluation.experiment.fitting import Filled
from gsparc.evaluation.experiment.places import compare_places, facts_and_table
from gsparc.evaluation.summary import write_summary

SETTINGS = {"fingerprints": {}, "splits": [], "against": ["nearest"], "calibrate": 0, "rows": 4}


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cells")
    for model in ("gp", "idw"):
        (folder / model).mkdir()
        towns.trained(spectra(folder / model / "own.npz", rows=60), model)
    cells = [Filled(Cell("own", "random", model, None, None), folder / model, {}) for model in ("gp", "idw")]
    return [*cells, Filled(Cell("own", "random", "gone", None, None), folder / "gone", {})]


def compared(filled, kept, locate=locate, **more):
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        return compare_places(filled, SETTINGS | more, kept, locate)


def test_models_with_a_variance_stand_beside_plain_methods(filled, tmp_path, caplog):
    found = compared(filled, tmp_path)
    assert found.method.tolist() == ["gp", "nearest"] and found.median_m[0] < found.median_m[1]
    assert found.held.notna().tolist() == [True, False]
    assert "own/random/idw cannot be located" in caplog.text
    facts, table = facts_and_table(found)
    assert facts["own/random/nearest/held"] is None and table.row_count == 2
    assert compared(filled[:1], tmp_path, locate=None).equals(found)  # what is kept is not located again


def test_of_several_seeds_the_first_alone_is_located(filled, tmp_path):
    """All draws were located, for hours, and all but the first thrown away."""
    folders = []

    def located(config, folder):
        folders.append(folder)
        return locate(config, folder)

    again = Filled(Cell("own", "random", "gp", None, 1), tmp_path / "second", {})
    again.folder.mkdir()
    shutil.copy(filled[0].checkpoint, again.checkpoint)
    compared([filled[0], again], tmp_path, located, rows=5)
    assert folders == [filled[0].folder / "locate"]


def test_without_a_variance_there_is_nothing_to_compare(filled, tmp_path):
    with pytest.raises(ValueError, match="task=locate: no cell keeps a model that states a variance"):
        compared(filled[1:], tmp_path)


def test_fingerprints_are_split_as_is_said(tmp_path):
    file, splits = tmp_path / "lib.npz", []
    file.write_bytes(b"levels")

    def located(config, folder):
        splits.append((config.dataset.name, config.dataset.split, config.dataset.file))
        figures = {"median_m": 1.0, "p90_m": 2.0, "coverage": 0.9}
        facts = {f"locate/{name}": value for name, value in figures.items()} | {"time/locate_ms_p50": 3.0}
        write_summary(folder / "summary.json", facts)

    chosen = {"fingerprints": {"lib": str(file)}, "splits": ["random", "blocks"]}
    found = compared([], tmp_path, located, **chosen)
    assert found[["dataset", "split", "method"]].to_numpy().tolist() == [
        ["lib", "blocks", "weighted_knn"], ["lib", "random", "weighted_knn"],
    ]  # fmt: skip
    assert splits == [("fingerprints", split, str(file)) for split in ("random", "blocks")]
