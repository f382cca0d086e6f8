"""`gsparc study`: a multirun of trainings, of variants of a model or of errors of the data."""

import json

import pytest
from campaigns import spectra
from doors import knock
from hydra import compose as compose_with_hydra
from hydra import initialize_config_module

from gsparc.commands.listing import COMMANDS
from gsparc.evaluation.results import read_columns
from gsparc.models.registry import build, fill_defaults
from gsparc.models.terms import EffectSettings

VARIANTS = ("plain", "confidence", "distance", "array", "moving_array", "phase", "visibility")
VARIANTS += ("power", "all", "simple")


@pytest.mark.slow
def test_a_study_is_a_multirun_and_leaves_out_what_the_data_do_not_allow(tmp_path):
    answer = knock(
        COMMANDS["study"].run,
        "study",
        [
            "kind=effects",
            "variant=plain,phase",
            "dataset=own",
            f"dataset.file={spectra(tmp_path / 'own.npz')}",
            "threads=1",
            "baselines=[mean]",
            "model.field.count=20",
            "trainer.max_steps=6",
            "trainer.val_check_interval=3",
            "logger=none",
            "+hydra.callbacks.sweep.rounds=2",
            f"hydra.sweep.dir={tmp_path / 'sweep'}",
        ],
    )
    assert answer.status == 0, answer
    assert "is left out: model.effects.phase=true is not possible" in " ".join(answer.out)
    settings = read_columns(tmp_path / "sweep" / "sweep.csv")["method and setting"]
    assert settings[0].startswith("gsparc variant=plain ") and settings[1] == "mean (baseline)"
    assert json.loads((tmp_path / "sweep" / "summary.json").read_text())["sweep/runs"] == 1


def test_variants_join_the_models_settings_where_they_are_interpolations():
    """Both studies of the pages ended after 8 s: `error: visibility: Missing key visibility`."""
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        chosen = {name: compose_with_hydra("study", [f"variant={name}"]) for name in VARIANTS}
    switches = {name: build(fill_defaults(of.model)).switches for name, of in chosen.items()}
    assert all(isinstance(switch, EffectSettings) for switch in switches.values())
    assert (switches["plain"].image, switches["plain"].phase) == (True, False)
    assert (switches["all"].image, switches["plain"].visibility) == ("auto", "auto")
