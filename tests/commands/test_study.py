"""`gsparc study`: each kind leaves its table, figure and summary."""

import csv
import json
from functools import partial

import pytest
from campaigns import compose, runs_in, spectra
from hydra import initialize_config_module

from gsparc.commands.study import configs_of, task
from gsparc.models.registry import build
from gsparc.models.terms import EffectSettings

HYDRA = partial(initialize_config_module, "gsparc.conf", version_base="1.3")
PLAIN = "{effects: {array: false, residual: false}, field: {count: 20}}"
LINES = {
    "effects": ([], ["none"]),
    "positions": (["kind.errors_m=[0.1]"], ["none", "query", "train", "train_known"]),
    "measurements": (["kind.keep=[1,0.5]", "rounds=1"], ["keep", "keep"]),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", LINES)
def test_a_study_leaves_a_table_a_figure_and_a_summary(kind, tmp_path, monkeypatch):
    runs_in(monkeypatch, tmp_path)
    more, conditions = LINES[kind]
    config = compose(
        "dataset=own",
        f"dataset.file='{spectra(tmp_path / 'own.npz')}'",
        f"kind={kind}",
        "threads=1",
        "~variants",
        f"+variants={{plain: {PLAIN}}}",
        "baselines=[mean]",
        "query_s=0.5",
        "trainer.max_steps=6",
        "trainer.val_check_interval=3",
        *more,
        config="study",
    )
    with HYDRA():
        rows = task(config)
    assert list(rows.what) == 2 * conditions
    facts = json.loads((tmp_path / "summary.json").read_text())
    assert facts["study/rounds"] and facts["dataset/name"] == "own" and facts["seed"] == 0
    assert (rows.train_s > 0).all() and (rows.query_ms > 0).all()
    with (tmp_path / "study.csv").open() as file:
        stored = list(csv.DictReader(file))
    assert [float(row["value"]) for row in stored] == list(rows.value)
    assert (tmp_path / "study.png").stat().st_size > 10_000


def test_variants_join_the_models_settings_where_they_are_interpolations():
    """Both studies of the pages ended after 8 s: `error: visibility: Missing key visibility`."""
    config = compose("kind=effects", config="study")
    with HYDRA():
        configs = configs_of(config)
    variants = {name: build(config.model) for name, config in configs.items()}
    switches = {name: method.switches for name, method in variants.items() if name != "gp"}
    assert len(switches) == 9 and all(isinstance(one, EffectSettings) for one in switches.values())
    assert (switches["plain"].image, switches["plain"].phase) == (True, False)
    assert (switches["all"].image, switches["plain"].visibility) == ("auto", "auto")
