"""Methods by name, and what a file may ask to build."""

import pytest
from refusals import refused

from gsparc.base import instantiate
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.registry import build, method_class


def test_a_typo_gets_the_nearest_name():
    refused("did you mean 'nearest'", method_class, "neareast")
    refused(r"there are .*gp, gsparc, .*idw", method_class, "xxxxxxxx")


def test_a_config_becomes_a_method():
    method = build({"_target_": "gsparc.models.baselines.gp.GaussianProcess", "components": 7})
    assert isinstance(method, GaussianProcess) and method.limit == 7
    refused(r"not a gsparc\.models\.method\.Method", build, {"_target_": "pathlib.Path"})
    refused("_target_", build, {"components": 7})


def test_entry_points_of_plugins_were_read_for_every_class_of_a_checkpoint(monkeypatch):
    """65 times for a model of four stations: most of the seconds of `gsparc.load`."""
    monkeypatch.setattr(instantiate, "plugins", lambda group: pytest.fail("entry points are read"))
    instantiate.refuse_foreign("gsparc.models.baselines.gp.GaussianProcess")
    monkeypatch.setattr(instantiate, "plugins", lambda group: {})
    for path in (
        "gsparc.base.instantiate.import_target",
        "os.system",
        "gsparc.models.baselines.gp.torch.nn.Linear",
        None,
    ):
        refused("not a class of gsparc", instantiate.refuse_foreign, path)
