"""A job's folder is named after its overrides, in as many characters as a file system takes."""

from __future__ import annotations

import hydra
import pytest
from hydra import initialize_config_module
from hydra.core.hydra_config import HydraConfig

from gsparc.commands.shared.job_name import MOST, job_name

MANY = [f"model.effects.an_effect_of_number_{n}=false" for n in range(20)]


def test_few_overrides_are_all_of_the_name():
    given = ["seed=1", "model.field.count=40", "dataset.file=/x/y.npz"]
    assert job_name(given, ["dataset.file"]) == "model.field.count-40_seed-1"
    assert job_name([]) == ""


def test_many_overrides_begin_the_name_and_no_two_share_it():
    one, two = (job_name(["model.emission.hidden=8", *MANY, f"zone={n}"]) for n in range(2))
    assert one != two and one[:-8] == two[:-8] and one[-9] == "~"
    assert one.startswith("an_effect_of_number_0-false_") and len(one.encode()) <= MOST
    assert len(job_name(["model.name=" + "ü" * 300]).encode()) <= MOST


@pytest.mark.parametrize("more", [[], MANY], ids=["few", "many"])
def test_the_command_line_names_folders_by_it(more, monkeypatch):
    import gsparc.commands.shared.cli  # noqa: F401

    given = ["dataset=own", "dataset.file=x.npz", *(f"+{one}" for one in more)]
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        config = hydra.compose("train", overrides=given, return_hydra_config=True)
    config.hydra.job.num = 3
    monkeypatch.setattr(HydraConfig.instance(), "cfg", config)
    unnamed = ["dataset.file"]
    assert config.hydra.sweep.subdir == f"3_{job_name(config.hydra.overrides.task, unnamed)}"
    assert "x.npz" not in config.hydra.sweep.subdir


def test_a_path_makes_no_folders_within_the_folder():
    """Jobs of `init.file=walls/a.yaml` lay a level deeper, where no report of the sweep looked for them."""
    assert job_name(["init.file=walls/a.yaml", "seed=0"]) == "init.file-walls+a.yaml_seed-0"
    assert "/" not in job_name([f"init.file={'walls/' * 60}a.yaml"])
