"""Methods by name, and what a file may ask to build."""

import pytest
from refusals import refused

from gsparc.base import instantiate
from gsparc.models import registry
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.baselines.idw import InverseDistance
from gsparc.models.registry import build, method_class, plain_methods


def test_a_typo_gets_the_nearest_name():
    refused("did you mean 'nearest'", method_class, "neareast")
    refused(r"there are .*gp, gsparc, .*idw", method_class, "xxxxxxxx")


class Twice(InverseDistance):
    """A plain method of somebody's own."""

    baseline_order = 45


class Thrice(Twice):
    """No plain one, though it derives from one."""


def test_a_plain_method_is_its_class_and_its_name(monkeypatch):
    """It stood in five lists."""
    paths = {kind.__name__.lower(): f"{__name__}.{kind.__name__}" for kind in (Twice, Thrice)}
    before, every = plain_methods(), registry.all_methods() | paths
    monkeypatch.setattr(registry, "all_methods", lambda: every)
    plain_methods.cache_clear()
    assert plain_methods() == (*before[:4], "twice", *before[4:]) and before[3:6:2] == (
        "idw",
        "direct_beam",
    )
    plain_methods.cache_clear()


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
