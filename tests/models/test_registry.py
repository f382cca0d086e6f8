"""Methods by name, and what a file may ask to build."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest
import yaml
from hydra.utils import get_class
from hydra.utils import instantiate as construct

from gsparc.data import instantiate
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.method import Method
from gsparc.models.registry import METHODS, build, method_class

MODELS = Path(__file__).parents[2] / "conf" / "model"


@pytest.mark.parametrize("name", METHODS)
def test_every_name_is_a_method(name):
    assert issubclass(method_class(name), Method)


def test_every_model_of_the_configuration_has_a_name():
    """`model=directional_gp` could be trained, but was no baseline, nor read from a bare checkpoint."""
    targets = {file.stem: yaml.safe_load(file.read_text())["_target_"] for file in MODELS.glob("*.yaml")}
    assert targets == METHODS


def defaults(kind: type) -> dict[str, object]:
    """Defaults of a class's arguments, also of those that a base class takes."""
    taken = [inspect.signature(base.__init__).parameters for base in reversed(kind.__mro__)]
    return {name: p.default for of in taken for name, p in of.items() if p.kind is not p.VAR_KEYWORD}


def assert_same(node: dict, kind: type) -> None:
    for key, value in node.items():
        if key == "_target_" or (isinstance(value, str) and value.startswith("${")):
            continue  # of the run
        default = defaults(kind)[key]
        if isinstance(value, dict):
            made = construct(value)
            assert made == (type(made)() if default is None else default), key
        else:
            assert value == (list(default) if isinstance(default, tuple) else default), key


@pytest.mark.parametrize("file", sorted(MODELS.glob("*.yaml")), ids=lambda file: file.stem)
def test_defaults_of_a_class_are_those_of_its_configuration(file):
    """`baselines=[gsrf]` trained other settings than `model=gsrf`."""
    node = yaml.safe_load(file.read_text())
    assert_same(node, get_class(node["_target_"]))


def test_a_typo_gets_the_nearest_name():
    with pytest.raises(ValueError, match="did you mean 'nearest'"):
        method_class("neareast")
    with pytest.raises(ValueError, match=r"there are .*gp, gsparc, .*idw"):
        method_class("xxxxxxxx")


def test_a_config_becomes_a_method():
    method = build({"_target_": "gsparc.models.baselines.gp.GaussianProcess", "components": 7})
    assert isinstance(method, GaussianProcess) and method.limit == 7
    with pytest.raises(ValueError, match=r"not a gsparc\.models\.method\.Method"):
        build({"_target_": "pathlib.Path"})
    with pytest.raises(ValueError, match="_target_"):
        build({"components": 7})


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "gsparc.evaluation.summary.os.system",
        "gsparc.evaluation.summary.write_summary",
        "gsparc.nowhere.X",
        3,
        "builtins.eval",
    ],
)
def test_text_from_a_file_builds_our_classes_only(target, tmp_path):
    hostile = {
        "_target_": "gsparc.models.baselines.gp.GaussianProcess",
        "components": {"_target_": target, "_args_": ["x"]},
    }
    for config in (hostile, {"_target_": target}, {**hostile, "components": [hostile["components"]]}):
        with pytest.raises(ValueError, match="refused"):
            build(config, trusted=False)
    assert build({"_target_": "gsparc.models.baselines.gp.GaussianProcess"}, trusted=False).limit > 0


def test_entry_points_of_plugins_were_read_for_every_class_of_a_checkpoint(monkeypatch):
    """65 times for a model of four stations: most of the seconds of `gsparc.load`."""
    monkeypatch.setattr(instantiate, "plugins", lambda group: pytest.fail("entry points are read"))
    instantiate.refuse_foreign("gsparc.models.baselines.gp.GaussianProcess")
    monkeypatch.setattr(instantiate, "plugins", lambda group: {})
    for path in (
        "gsparc.data.instantiate.find",
        "os.system",
        "gsparc.models.baselines.gp.torch.nn.Linear",
        None,
    ):
        with pytest.raises(ValueError, match="not a class of gsparc"):
            instantiate.refuse_foreign(path)
