"""Methods and datasets of other packages: found, trained, stored, compared;
a broken one disturbs nobody.
"""

import importlib
import tomllib
from pathlib import Path

import numpy as np
import pytest
from campaigns import compose, spectra
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.errors import MissingConfigException
from invented import invent
from refusals import refused
from scipy.spatial import cKDTree

import gsparc
from gsparc.commands.evaluate import evaluate_files
from gsparc.commands.shared.cli import offer_plugins
from gsparc.commands.train import train
from gsparc.data.splits import Fold
from gsparc.datasets.load import datamodule
from gsparc.evaluation.console import error_in_one_line
from gsparc.models.registry import build, method_class
from gsparc.runs.experiment.contenders import unlisted_contenders
from gsparc.training.context import FitContext

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Makes a project's entry points known as an installation would."""

    def install(project: Path) -> None:
        declared = tomllib.loads((project / "pyproject.toml").read_text())["project"]
        info = (
            tmp_path
            / "site"
            / f"{declared['name'].replace('-', '_')}-{declared['version']}.dist-info"
        )
        info.mkdir(parents=True)
        (info / "METADATA").write_text(
            f"Name: {declared['name']}\nVersion: {declared['version']}\n"
        )
        groups = declared["entry-points"].items()
        lines = [
            f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in of.items()) for group, of in groups
        ]
        (info / "entry_points.txt").write_text("\n".join(lines))
        monkeypatch.syspath_prepend(str(project))
        monkeypatch.syspath_prepend(str(info.parent))
        importlib.invalidate_caches()
        offer_plugins()

    Plugins.instance()  # before the copy: they store choices, which later tests need
    monkeypatch.setattr(ConfigStore.instance(), "repo", {**ConfigStore.instance().repo})
    for group in ("model", "dataset"):
        ConfigStore.instance().repo[group] = {**ConfigStore.instance().repo.get(group, {})}
    return install


def test_a_method_and_a_dataset_of_another_package(installed, tmp_path):
    installed(EXAMPLES / "own-method")
    config = compose(
        "dataset=corridor",
        "dataset.count=60",
        "model=nearest_k",
        "model.k=2",
        "baselines=[mean]",
        "logger=none",
    )
    facts, objects = train(config, tmp_path)
    assert facts["model/name"] == "nearest_k" and objects.methods[0].k == 2
    assert facts["test/rmse_db"] < facts["baseline/mean/rmse_db"]
    # Its class is out of a file, and of a plugin: trusted
    predictor = gsparc.load(objects.checkpoints[0])
    assert predictor.rssi(rx=[30.0, 1.0, 1.5]).shape == (1,)
    assert (
        datamodule({"_target_": "own_method.Corridor", "count": 9}, trusted=False).name
        == "corridor"
    )
    assert unlisted_contenders()["nearest_k"].overrides(None) == ["model=nearest_k"]
    assert {*unlisted_contenders()} == {"nearest_k", "other_carriers", "direct_beam", "ridge"}
    again, *_ = evaluate_files([objects.checkpoints[0]])
    assert again.facts["test/rmse_db"] == facts["test/rmse_db"]


def test_a_plugin_was_no_nearest_name(installed):
    """`model=nearest_kk` was answered with `nearest` beside an installed `nearest_k`."""
    installed(EXAMPLES / "own-method")
    with pytest.raises(MissingConfigException) as error:
        compose("model=nearest_kk")
    assert error_in_one_line(error.value) == (
        "model=nearest_kk: no such choice; did you mean 'nearest_k'?"
    )


def test_a_method_that_could_not_answer_once_stored_was_trained(installed):
    """Its table was shown; then `gsparc.load`,
    `evaluate` and `compare` failed on its checkpoint.
    """
    installed(EXAMPLES / "own-method")

    class Tree(method_class("nearest_k")):
        def _learn(self, positions, targets):
            self._tree = cKDTree(positions)
            return super()._learn(positions, targets)

    rows = np.arange(12)
    fold = Fold(rows, rows[:0], rows[:0])
    with pytest.raises(
        ValueError, match="nearest_k: its checkpoint loses _tree: name it in `stored`"
    ):
        Tree().fit(invent("rssi", 12), fold, FitContext())


def test_without_the_plugin_its_checkpoint_is_refused(installed, tmp_path):
    refused("install that package here", build, {"_target_": "own_method.NearestK"}, trusted=False)
    refused("no method is called 'nearest_k'", method_class, "nearest_k")


def test_a_broken_plugin_is_warned_of_and_named_where_it_is_chosen(installed, tmp_path, caplog):
    """Six lines of a Python warning, then `no such choice; did you mean 'broken_off'?`."""
    project = tmp_path / "broken"
    project.mkdir()
    entry = '[project.entry-points."gsparc.models"]\nbroken = "no_such_module:Nothing"\n'
    (project / "pyproject.toml").write_text(f'[project]\nname = "broken"\nversion = "1"\n{entry}')
    installed(project)
    reason = "ModuleNotFoundError: No module named 'no_such_module'"
    assert caplog.messages == [f"plugin broken (no_such_module.Nothing) is left out: {reason}"]
    with pytest.raises(MissingConfigException) as error:
        compose("model=broken")
    said = f"model=broken: its plugin (no_such_module.Nothing) cannot be imported: {reason}"
    assert error_in_one_line(error.value) == said


def test_a_baseline_by_an_older_name_was_silently_none(installed, tmp_path, caplog):
    project = tmp_path / "older"
    project.mkdir()
    (project / "older.py").write_text(
        "from gsparc.models.baselines.mean import Mean\n\n\nclass Older(Mean):\n    plain_place "
        "= 45\n"
    )
    entry = '[project.entry-points."gsparc.models"]\nolder = "older:Older"\n'
    (project / "pyproject.toml").write_text(f'[project]\nname = "older"\nversion = "1"\n{entry}')
    installed(project)
    assert caplog.messages == [
        "plugin older: no baseline; plain_place is called baseline_order now"
    ]


def test_a_third_party_library_as_a_plugin(installed, tmp_path):
    pytest.importorskip("gpytorch", reason="GPyTorch is not installed: pip install gpytorch")
    installed(EXAMPLES / "gpytorch-method")
    file = spectra(tmp_path / "own.npz")
    config = compose(
        "dataset=own",
        f"dataset.file={file}",
        "model=gpytorch",
        "model.steps=5",
        "baselines=[mean]",
        "logger=none",
    )
    facts, objects = train(config, tmp_path)
    assert facts["test/mse"] < facts["baseline/mean/mse"]
    place = objects.data.moving[0] + objects.data.site.origin
    predictor = gsparc.load(objects.checkpoints[0])
    again = predictor.spectrum(**{objects.data.site.moving_end: place})
    assert again.shape == objects.data.target.shape[1:]
