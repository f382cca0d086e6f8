"""Every option is heeded or named: tiny fits of each method on each kind of data, and options perturbed."""

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

from gsparc.data import executor, heeded
from gsparc.data.executor import Engine
from gsparc.data.load import datamodule, split_for
from gsparc.evaluation.console import to_dict
from gsparc.evaluation.experiment import options
from gsparc.evaluation.experiment.folds import fit_folds
from gsparc.models.registry import build, fill_defaults
from gsparc.models.terms import EffectSettings

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
    """Names of options without effect, and answers at the test rows, after what `train` does until then."""
    given = ["dataset=own", f"dataset.file='{file_of(world)}'", "logger=none", *overrides]
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        whole = hydra.compose("train", overrides=given, return_hydra_config=True)
    config = OmegaConf.masked_copy(whole, [key for key in whole if key != "hydra"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HydraConfig.instance(), "cfg", whole)
        method = build(fill_defaults(config.model))
        reads = options.options_to_note(config, method)
        with heeded.record_reads(reads):
            data = datamodule(config.dataset).measurements
            split = split_for(to_dict(config.split), data)
            folder = Path(mkdtemp())
            fits = fit_folds(
                method, data, split,
                [fit_context(config, run_dir=folder)] * len(split.folds),
            )  # fmt: skip
            method, rows = fits.methods[0], split.folds[0].test
            method.predict(data.batch(rows[:1]))
        unused = options.warn_of_unheeded(reads, method, data) or ""
        return {one.partition("=")[0] for one in unused.split(", ") if one}, method.predict(
            data.batch(rows)
        ).mean


# Options of which a plain method heeds those of the split alone.
TRAINING = {
    "trainer.val_check_interval": 2, "callbacks.densify.min_gaussians": 5, "callbacks.reset.ceiling": 0.02,
    "dataset.batch_size": 7,
}  # fmt: skip
OF_RUN = {"effort": 0.4, "stations": "each", "split.redraw": "true", **TRAINING}
SPLIT = {"split.test_fraction": 0.25, "split.thin": 0.9}
FIELD = {
    "trainer.max_steps": 4, "model.field.count": 40, "model.field.near": 1.5, "model.field.margin": 1.0,
    "model.emission.encoding.anchors": 20, "model.emission.init_scale": 0.2, "model.attenuation.gain": 3.0,
    "model.raster.low_pass": 0.2, "model.loss.ssim_weight": 0.3, "model.optimizer.emission": 0.01,
    "model.confidence.alpha": 0.2, "model.refit": "false",
}  # fmt: skip
INIT = {"init.searches": 2, "init.rows": 500}
ALL_FIELD = set(FIELD) | set(TRAINING)  # what a closed form leaves
NEVER = {"callbacks.densify.min_gaussians", "callbacks.reset.ceiling"}  # of trainings of four steps
SPHERE = {"model.field.margin", "model.attenuation.gain"}
BOX = {"model.field.near", "model.attenuation.gain"}
SSIM = {"model.loss.ssim_weight"}
PLAIN = {
    "nearest": {}, "kriging": {}, "idw": {"model.neighbours": 4, "model.power": 1.0},
    "gp": {"model.components": 3, "model.mean": "constant"},
}  # fmt: skip
PEERS = ("gsrf", "wrfgs", "swiftwrf", "nerf2")
OTHER = {  # values to perturb options by
    "trainer.val_check_interval": 3, "callbacks.densify.min_gaussians": 8, "callbacks.reset.ceiling": 0.04,
    "dataset.batch_size": 5, "effort": 0.5, "stations": "auto", "split.redraw": "false", "split.thin": 0.7,
    "trainer.max_steps": 3, "model.field.count": 30, "model.field.near": 1.2, "model.field.margin": 2.5,
    "model.emission.encoding.anchors": 10, "model.emission.init_scale": 0.3, "model.attenuation.gain": 2.5,
    "model.raster.low_pass": 0.5, "model.loss.ssim_weight": 0.1, "model.optimizer.emission": 0.02,
    "model.confidence.alpha": 0.4, "model.refit": "true", "model.components": 5, "model.mean": "distance",
    "init.searches": 3, "init.rows": 400, "model.power": 3.0,
}  # fmt: skip

Case = tuple[str, str, dict, set]


def plain_case(world: str, model: str) -> Case:
    powers = world in ("power", "stations")
    own = PLAIN.get(model, {})
    unused = set(OF_RUN) - ({"stations"} if world == "stations" else set())
    unused |= {"model.components" if powers else "model.mean"} if model == "gp" else set()
    return world, model, OF_RUN | SPLIT | own, unused


FAST: list[Case] = [
    plain_case("power", "gp"),
    ("tone", "splat", TRAINING | FIELD, NEVER | BOX | SSIM),
    ("power", "gsparc", TRAINING | FIELD | INIT, ALL_FIELD | set(INIT)),
]
CASES: list[Case] = [
    *(plain_case(world, model) for world in WORLDS for model in PLAIN),
    *(plain_case(world, "complex_gp") for world in ("tone", "antennas")),
    *(plain_case(world, "distance_law") for world in ("power", "stations")),
    *(plain_case(world, model) for world in WORLDS for model in ("zero", "mean")),
    ("array", "splat", TRAINING | FIELD, NEVER | SPHERE | {"model.confidence.alpha"}),
    *((world, "splat", TRAINING | FIELD, NEVER | BOX) for world in ("moving", "image")),
    *((w, "splat", TRAINING | FIELD, NEVER | BOX | SSIM) for w in ("antennas", "power")),
    ("array", "gsparc", TRAINING | FIELD | INIT, NEVER | SPHERE | set(INIT) | {"model.confidence.alpha"}),
    ("image", "gsparc", TRAINING | FIELD | INIT, NEVER | BOX | set(INIT)),
    ("stations", "gsparc", TRAINING | FIELD | INIT, ALL_FIELD | set(INIT)),
    ("array", "array", TRAINING | {"model.field.margin": 1.0}, {*TRAINING, "model.field.margin"}),
    *((w, m, TRAINING | {"model.max_steps": 2}, set(TRAINING)) for w in ("array", "image") for m in PEERS),
    ("array", "ngrf", TRAINING | {"model.max_steps": 2}, set(TRAINING)),
]  # fmt: skip


def name_of(one: Case | str) -> str:
    return one if isinstance(one, str) else f"{one[1]}-{one[0]}"


def words(options: dict) -> list[str]:
    return [f"{name}={value}" for name, value in options.items()]


def check(case: Case) -> None:
    world, model, given, unused = case
    assert fitted(world, f"model={model}", *words(given))[0] == unused


@pytest.mark.parametrize("case", FAST, ids=name_of)
def test_what_a_method_does_not_heed_is_named(case):
    check(case)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=name_of)
def test_what_every_method_does_not_heed_of_every_kind(case):
    check(case)


def perturbed(case: Case, option: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Answers with the value of a case, and with another."""
    world, model, given, _ = case
    both = given, given | {option: OTHER[option]}
    first, second = (fitted(world, f"model={model}", *words(one))[1] for one in both)
    return first, second


NOTED = [(case, option) for case in CASES for option in sorted(case[3])]
DRAWN = np.random.default_rng(57).permutation(len(NOTED))[:10]


@pytest.mark.slow
@pytest.mark.parametrize("case, option", [NOTED[i] for i in DRAWN], ids=name_of)
def test_what_is_named_changes_no_bit_of_the_answers(case, option):
    assert torch.equal(*perturbed(case, option))


def warned(caplog) -> list[str]:
    return [one.message for one in caplog.records if "without effect" in one.message]


@pytest.mark.slow
def test_a_distance_law_of_gaussians_means_nothing_to_powers(caplog):
    """`model.attenuation.inverse_distance=true` on powers was ignored without a word."""
    falls = "model.attenuation.inverse_distance=true"
    unused, answers = fitted("power", "model=gsparc", falls)
    assert unused == {"model.attenuation.inverse_distance"}
    said = f"options without effect here: {falls} (of rendered Gaussians alone: say model=splat)"
    assert warned(caplog) == [said]
    assert torch.equal(answers, fitted("power", "model=gsparc")[1])


@pytest.mark.slow
@pytest.mark.parametrize(("world", "options", "unused", "said"), [
    ("image", "model=nearest trainer.max_steps=1200", {"trainer.max_steps"},
     "(nearest takes no gradient steps here: model=splat does)"),
    ("image", "model=nearest seed=1", set(), ""),
    ("power", "model=gsparc model.steps=7", {"model.steps"},
     "model.steps=7 (gsparc takes no gradient steps here: model=splat does)"),
    ("power", "model=gsparc init=vectors", {"init"}, "init=vectors (here it is init=powers)"),
    ("array", "model=gsparc init=vectors model.steps=0", set(), ""),
    ("array", "model=gsparc init=auto model.effects.array=true model.steps=0", set(), ""),
    ("power", "model=gsparc model.effects.phase=false", {"model.effects.phase"}, ""),
    ("tone", "model=gsparc model.effects.image=true effort=.1", {"model.effects.image"}, ""),
    ("image", "model=gsparc model.effects.residual=false trainer.max_steps=1", set(), ""),
    ("tone", "model=splat model.field.count=20 model.steps=3", set(), ""),
    ("tone", "model=splat model.field.count=20 model.steps=3 trainer.max_steps=2", {"model.steps"}, ""),
])  # fmt: skip
def test_what_decides_nothing_here_is_named_with_why(world, options, unused, said, caplog):
    assert fitted(world, *options.split())[0] == unused
    assert [line.endswith(said) for line in warned(caplog)] == [True] * bool(unused)


@pytest.mark.slow
def test_hidden_units_beside_a_process_with_all_the_weight(caplog):
    """It was exactly the Gaussian process, printed as hidden=16; then hidden=16 "without effect", which cost
    the start in closed form and .3 dB.
    """
    given = "model=gsparc", "trainer.max_steps=2", "model.field.count=20"
    plain = fitted("image", *given)[1]
    unused, answers = fitted("image", *given, "model.emission.hidden=16")
    assert not unused and torch.equal(answers, plain)
    said = (
        "a plain process has all the weight, Gaussians (init=uniform, encoding=fourier, activation=sigmoid, "
    )
    assert caplog.messages[-1].startswith(f"{said}steps=2) none: model=splat is the field alone")


def test_hidden_units_that_cost_the_start_in_closed_form_were_said_to_have_no_effect(caplog):
    """So were steps and the number of Gaussians, without which the process may not have all the weight."""
    given = "model=gsparc", "model.steps=0", "model.field.count=20", "model.emission.hidden=16"
    assert not fitted("array", *given)[0] and not warned(caplog)
    assert "Gaussians (init=sphere, encoding=fourier, activation=sigmoid, steps=0) none" in caplog.text


@pytest.mark.parametrize("none", ["model.steps=0", "trainer.max_steps=0"])
def test_callbacks_of_a_training_without_steps(none, caplog):
    """The log listed callbacks for "at most 0 steps"; which of the two numbers asked for that is heeded."""
    given = "callbacks.densify.start=0.2", "callbacks=early_stopping", "trainer.max_time=00:00:01:00"
    unused, _ = fitted("array", "model=gsparc", none, *given)
    assert unused == {"callbacks.densify.start", "callbacks", "trainer.max_time"}
    assert warned(caplog)[0].endswith("(no gradient steps are asked for: say model.steps=auto)")


def test_phases_of_snapshots_mean_nothing_to_powers():
    """`model.loss.snapshot=phase` of powers ended in an IndexError."""
    given = "model=splat", "model.field.count=20", "trainer.max_steps=1", "model.loss.snapshot=phase"
    assert fitted("power", *given)[0] == {"model.loss.snapshot"}
    assert not fitted("tone", *given)[0]


# Where nothing that hides is found, or no station that was never heard is asked about.
FOUND_NOTHING = {("tone", "visibility"), ("antennas", "visibility"), ("stations", "visibility")}
# A plain process answers the same, which a warning or the log says.
ALONE = {("power", "power"), ("moving", "moving_array")}


SWITCHED = [(world, switch) for world in WORLDS for switch in EffectSettings.__dataclass_fields__]
OFTEN = {*np.random.default_rng(11).permutation(len(SWITCHED))[:12].tolist()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "switch"),
    [pytest.param(*one, marks=() if i in OFTEN else pytest.mark.rare) for i, one in enumerate(SWITCHED)],
)
def test_a_term_switched_off_changes_answers_or_is_named_or_refused(world, switch):
    """Of `image` and `residual` some were counted as heeded that decide nothing."""
    if world in ("array", "image", "moving") and switch == "visibility":
        pytest.skip("refused or named, see test_terms.py")
    unused, answers = fitted(world, "model=gsparc", "effort=.3", f"model.effects.{switch}=false")
    same = torch.equal(answers, fitted(world, "model=gsparc", "effort=.3")[1])
    assert same == bool(unused) or (world, switch) in FOUND_NOTHING | ALONE


@pytest.mark.slow
def test_residual_false_left_a_moving_array_its_residual():
    given = "model=gsparc", "model.effects.residual=false"
    unused, answers = fitted("moving", *given)
    assert not unused and not torch.equal(answers, fitted("moving", "model=gsparc")[1])


@pytest.mark.slow
def test_what_other_processes_read_counts():
    """Stations fitted by joblib: everything would be named, as nothing was read here."""
    given = "model=idw", "stations=each", "model.neighbours=4", "model.power=1.0", "trainer.max_steps=3"
    executor.use_engine(Engine("joblib", 2))
    try:
        assert fitted("stations", *given)[0] == {"trainer.max_steps"}
    finally:
        executor.use_engine(Engine())
