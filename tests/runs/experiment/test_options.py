"""Settings that no part of a fit follows are named:
each method declares the groups that it reads.
"""

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import hydra
import numpy as np
import pytest
import torch
from campaigns import fit_context
from hydra import initialize_config_module
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from worlds import World, arrays

from gsparc.datasets.load import datamodule, split_for
from gsparc.evaluation.console import to_dict
from gsparc.models.registry import build, fill_defaults
from gsparc.runs.experiment import options
from gsparc.runs.experiment.folds import fit_folds

WORLDS = {
    "array": World("array", 1, 1, "tx", "metres", "none", "random", 30),
    "moving": World("moving_array", 1, 1, "rx", "metres", "none", "random", 30),
    "image": World("image", 1, 1, "rx", "metres", "none", "random", 30),
    "tone": World("tone", 1, 1, "rx", "metres", "none", "random", 30),
    "antennas": World("antennas", 1, 1, "rx", "metres", "none", "random", 30),
    "power": World("power", 1, 1, "rx", "metres", "none", "random", 30),
    "stations": World("power", 1, 4, "rx", "metres", "none", "random", 30),
}


@cache
def file_of(world: str) -> Path:
    path = Path(mkdtemp()) / f"{world}.npz"
    np.savez(path, **arrays(WORLDS[world], 0))
    return path


def fitted(world: str, *overrides: str) -> tuple[set[str], torch.Tensor]:
    """Names of options without effect, and answers at the test rows,
    after what `train` does until then.
    """
    given = ["dataset=own", f"dataset.file='{file_of(world)}'", "logger=none", *overrides]
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        whole = hydra.compose("train", overrides=given, return_hydra_config=True)
    config = OmegaConf.masked_copy(whole, [key for key in whole if key != "hydra"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HydraConfig.instance(), "cfg", whole)
        method = build(fill_defaults(config.model))
        data = datamodule(config.dataset).measurements
        split = split_for(to_dict(config.split), data)
        context = fit_context(config, run_dir=Path(mkdtemp()))
        method = fit_folds(method, data, split, [context] * len(split.folds)).methods[0]
        unused = options.warn_of_unheeded(config, method, data) or ""
    names = {option.partition("=")[0] for option in unused.split(", ") if option}
    return names, method.predict(data.batch(split.folds[0].test)).mean


TRAINING = {
    "trainer.val_check_interval": 2,
    "callbacks.densify.min_gaussians": 5,
    "callbacks.reset.ceiling": 0.02,
    "dataset.batch_size": 7,
}
OF_RUN = {"effort": 0.4, "stations": "each", "split.test_fraction": 0.25, **TRAINING}
FIELD = {
    "trainer.max_steps": 4,
    "model.field.count": 40,
    "model.attenuation.gain": 3.0,
    "model.raster.low_pass": 0.2,
    "model.loss.ssim_weight": 0.3,
    "model.optimizer.emission": 0.01,
    "model.confidence.alpha": 0.2,
    "model.refit": "false",
}
INIT = {"init.searches": 2}
ALONE = set(OF_RUN) - {"split.test_fraction"}  # what a plain method of one station leaves
RENDERED = TRAINING | FIELD
PEERS = ("gsrf", "wrfgs", "swiftwrf", "nerf2")
LARGER = {  # values to perturb options by
    "trainer.val_check_interval": 3,
    "callbacks.densify.min_gaussians": 8,
    "callbacks.reset.ceiling": 0.04,
    "dataset.batch_size": 5,
    "effort": 0.5,
    "trainer.max_steps": 3,
    "model.field.count": 30,
    "model.attenuation.gain": 2.5,
    "model.raster.low_pass": 0.5,
    "model.loss.ssim_weight": 0.1,
    "model.optimizer.emission": 0.02,
    "model.confidence.alpha": 0.4,
    "model.refit": "true",
    "stations": "auto",
    "init": "rays",
}
Case = tuple[str, str, dict, set]
FAST: list[Case] = [
    ("power", "gp", OF_RUN | {"model.mean": "constant"}, ALONE),
    ("tone", "splat", RENDERED | INIT, set()),
    ("power", "gsparc", RENDERED | INIT, set(RENDERED)),
]
CASES: list[Case] = [
    ("image", "idw", OF_RUN | {"model.neighbours": 4}, ALONE),
    ("stations", "gp", OF_RUN, ALONE - {"stations"}),
    ("tone", "complex_gp", OF_RUN | {"init": "vectors"}, ALONE | {"init"}),
    *((world, "splat", RENDERED, set()) for world in ("moving", "antennas", "power")),
    *((world, "gsparc", RENDERED | INIT, set()) for world in ("array", "image")),
    ("stations", "gsparc", RENDERED, set(RENDERED)),
    ("array", "array", TRAINING | {"model.field.count": 40}, set(TRAINING)),
    *(("image", m, TRAINING | {"model.max_steps": 2}, set(TRAINING)) for m in PEERS),
    ("array", "ngrf", TRAINING | {"model.max_steps": 2}, set(TRAINING)),
]


def name_of(case: Case | str) -> str:
    return case if isinstance(case, str) else f"{case[1]}-{case[0]}"


def words(given: dict) -> list[str]:
    return [f"{name}={value}" for name, value in given.items()]


def check(case: Case) -> None:
    world, model, given, unused = case
    assert fitted(world, f"model={model}", *words(given))[0] == unused


@pytest.mark.parametrize("case", FAST, ids=name_of)
def test_groups_that_a_method_does_not_read_are_named(case):
    check(case)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=name_of)
def test_groups_that_no_method_of_a_kind_reads_are_named(case):
    check(case)


NAMED = [(case, option) for case in (*FAST, *CASES) for option in sorted(case[3])]
DRAWN = np.random.default_rng(57).permutation(len(NAMED))[:10]


@pytest.mark.slow
@pytest.mark.parametrize("case, option", [NAMED[i] for i in DRAWN], ids=name_of)
def test_what_is_named_changes_no_bit_of_the_answers(case, option):
    world, model, given, _ = case
    changed = given | {option: LARGER[option]}
    first, second = (fitted(world, f"model={model}", *words(both))[1] for both in (given, changed))
    assert torch.equal(first, second)


def warned(caplog, about: str = "without effect") -> list[str]:
    return [record.message for record in caplog.records if about in record.message]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "given", "unused", "reason"),
    [
        (
            "image",
            "model=nearest trainer.max_steps=1200",
            {"trainer.max_steps"},
            "(nearest takes no gradient steps here: model=splat does)",
        ),
        ("image", "model=nearest seed=1", set(), ""),
        (
            "power",
            "model=gsparc model.steps=7",
            {"model.steps"},
            "model.steps=7 (gsparc does not use it here)",
        ),
        ("array", "model=gsparc init=vectors model.steps=0", set(), ""),
        ("tone", "model=gsparc model.field.count=0", set(), ""),
        ("power", "model=gsparc model.effects.phase=false", set(), ""),
        ("image", "model=gsparc model.effects.residual=false trainer.max_steps=1", set(), ""),
    ],
)
def test_what_decides_nothing_here_is_named_with_why(world, given, unused, reason, caplog):
    assert fitted(world, *given.split())[0] == unused
    lines = warned(caplog)
    assert len(lines) == (1 if unused else 0) and all(line.endswith(reason) for line in lines)


@pytest.mark.slow
def test_an_initialiser_of_another_kind_of_site_is_named(caplog):
    """`init=vectors` of powers tried what powers have, without a word."""
    fitted("power", "model=gsparc", "init=vectors")
    assert warned(caplog, "init=vectors") == [
        "init=vectors has no effect here: what is tried is powers"
    ]


def test_steps_of_the_trainer_win_over_the_models_with_a_word(caplog):
    given = "model=splat", "model.field.count=20", "model.steps=3", "trainer.max_steps=2"
    assert not fitted("tone", *given)[0]
    assert warned(caplog, "model.steps=3") == [
        "model.steps=3 gives way to the Trainer's max_steps or max_epochs"
    ]


@pytest.mark.slow
def test_hidden_units_beside_a_process_with_all_the_weight(caplog):
    """It was exactly the Gaussian process, printed as hidden=16; then hidden=16 "without effect",
    which cost the start in closed form and .3 dB.
    """
    given = "model=gsparc", "trainer.max_steps=2", "model.field.count=20"
    plain = fitted("image", *given)[1]
    unused, answers = fitted("image", *given, "model.emission.hidden=16")
    assert not unused and torch.equal(answers, plain)
    said = (
        "a plain process has all the weight, Gaussians (init=uniform, encoding=fourier, "
        "activation=sigmoid, "
    )
    assert caplog.messages[-1].startswith(f"{said}steps=2) none: model=splat is the field alone")


@pytest.mark.parametrize("none", ["model.steps=0", "trainer.max_steps=0"])
def test_callbacks_of_a_training_without_steps(none, caplog):
    """The log listed callbacks for "at most 0 steps"; the number that asks for none is followed."""
    given = (
        "callbacks.densify.start=0.2",
        "callbacks=early_stopping",
        "trainer.max_time=00:00:01:00",
    )
    unused, _ = fitted("array", "model=gsparc", none, *given)
    assert unused == {"callbacks.densify.start", "callbacks", "trainer.max_time"}


@pytest.mark.slow
def test_residual_false_left_a_moving_array_its_residual():
    given = "model=gsparc", "model.effects.residual=false"
    unused, answers = fitted("moving", *given)
    assert not unused and not torch.equal(answers, fitted("moving", "model=gsparc")[1])


def test_phases_of_snapshots_mean_nothing_to_powers():
    """`model.loss.snapshot=phase` of powers ended in an IndexError."""
    given = "model=splat", "model.field.count=20", "trainer.max_steps=1"
    plain, turned = (
        fitted("power", *given, *more)[1] for more in ((), ("model.loss.snapshot=phase",))
    )
    assert torch.equal(plain, turned)


@pytest.mark.slow
def test_a_distance_law_of_gaussians_means_nothing_to_powers(caplog):
    """`model.attenuation.inverse_distance=true` on powers was ignored without a word."""
    falls = "model.attenuation.inverse_distance=true"
    unused, answers = fitted("power", "model=gsparc", falls)
    assert unused == {"model.attenuation.inverse_distance"}
    assert warned(caplog) == [f"options without effect here: {falls} (gsparc does not use it here)"]
    assert torch.equal(answers, fitted("power", "model=gsparc")[1])


def test_hidden_units_that_cost_the_start_in_closed_form_were_said_to_have_no_effect(caplog):
    """So were steps and the number of Gaussians,
    without which the process may not have all the weight.
    """
    given = "model=gsparc", "model.steps=0", "model.field.count=20", "model.emission.hidden=16"
    assert not fitted("array", *given)[0] and not warned(caplog)
    assert (
        "Gaussians (init=sphere, encoding=fourier, activation=sigmoid, steps=0) none"
    ) in caplog.text
