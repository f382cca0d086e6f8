"""The configuration: every choice composes and builds; sweeps have directories of their own."""

import re
from dataclasses import is_dataclass
from inspect import signature
from pathlib import Path

import hydra
import pytest
import yaml
from campaigns import compose, spectra
from doors import knock
from hydra import initialize_config_module
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning import Trainer
from omegaconf import OmegaConf, open_dict

import gsparc.conf
from gsparc.commands.listing import COMMANDS
from gsparc.commands.train import main
from gsparc.field.gradient_stage import DEFAULTS
from gsparc.models.method import MethodFactory
from gsparc.models.registry import build, built_in_methods, method_class

CONF = Path(gsparc.conf.__path__[0])
GROUPS = ("dataset", "split", "trainer", "callbacks", "logger")  # of train.yaml
CHOICES = [
    sorted(f"{group}={file.stem}" for file in (CONF / group).glob("*.yaml")) for group in GROUPS
]
CHOICES += [[f"model={name}" for name in built_in_methods()]]
OWN = ["dataset=own", "dataset.file=x.npz"]
NEEDED = {"dataset=own": OWN[1:], "dataset=newrf": OWN[1:], "split=file": ["split.path=split.json"]}


def composed(monkeypatch, *overrides: str, command: str = "train"):
    """What a command would see, with the run's directory."""
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        config = hydra.compose(command, overrides=list(overrides), return_hydra_config=True)
    monkeypatch.setattr(HydraConfig.instance(), "cfg", config)  # what ${hydra:...} asks
    return config


def assert_builds(config) -> MethodFactory:
    method = build(config.model)
    assert isinstance(method, MethodFactory)
    for node in (config.callbacks or {}).values():
        instantiate(node)
    instantiate(config.trainer, accelerator="cpu", devices=1)  # there may be no other here
    return method


@pytest.mark.parametrize("row", range(max(map(len, CHOICES))))
def test_every_choice_composes_and_builds(row, monkeypatch):
    """One of each group at once; a model has the settings of its class,
    which `baselines=[NAME]` trains.
    """
    chosen = [choices[row] for choices in CHOICES if row < len(choices)]
    own = [] if any(one.startswith("dataset=") for one in chosen) else OWN
    config = composed(
        monkeypatch, *chosen, *own, *(word for one in chosen for word in NEEDED.get(one, ()))
    )
    method, name = assert_builds(config), CHOICES[-1][row][6:]
    for key, value in vars(method_class(name)()).items():
        if isinstance(value, (int, float, str, tuple)) or is_dataclass(value):
            assert getattr(method, key) == value, key
    if own:  # microseconds: no two share one
        assert re.fullmatch(rf"outputs/own/{name}/[\d_-]+-\d{{6}}", config.hydra.run.dir)


def said_in(file: Path) -> dict:
    """What a file says itself, on top of what the files of its own folder say that it builds on."""
    own = yaml.safe_load(file.read_text())
    below = [one for one in own.pop("defaults", []) if isinstance(one, str) and one != "_self_"]
    under = OmegaConf.merge(
        *(
            said_in((CONF if one[0] == "/" else file.parent) / f"{one.lstrip('/')}.yaml")
            for one in below
        ),
        own,
    )
    return OmegaConf.to_container(under)


@pytest.mark.slow
@pytest.mark.parametrize(
    "file",
    [f for group in ("experiment", "paper") for f in sorted((CONF / group).rglob("*.yaml"))],
    ids=str,
)
def test_what_an_experiment_says_is_what_is_done(file, monkeypatch):
    """`threads: 1` and `baselines: [nearest, gp]` of ablations never acted:
    train.yaml had the last word.
    """
    group, choice = (
        file.relative_to(CONF).parts[0],
        file.relative_to(CONF / file.relative_to(CONF).parts[0]),
    )
    link = file.stem in ("mcs", "pusch")
    command = "link" if link else "compare" if choice.parts[0] == "results" else "train"
    config = composed(monkeypatch, f"{group}={choice.with_suffix('')}", command=command)
    if command == "train":
        assert_builds(config)
    with open_dict(config):
        as_said = OmegaConf.merge(config, said_in(file))
    assert OmegaConf.to_container(as_said) == OmegaConf.to_container(config)


def test_all_settings_of_a_model_are_printed_and_kept(tmp_path):
    """Also those that its file leaves to its class."""
    given = (
        "model=idw",
        "model.power=3",
        "dataset=own",
        f"dataset.file={spectra(tmp_path / 'own.npz')}",
    )
    said = knock(COMMANDS["train"].run, "train", [*given, "--cfg", "job"])
    assert {"  power: 3", "  neighbours: 8"} < set(said.out)
    done = knock(main, "train.py", [*given, "baselines=[]", f"hydra.run.dir={tmp_path / 'run'}"])
    kept = yaml.safe_load((tmp_path / "run" / ".hydra" / "config.yaml").read_text())["model"]
    assert done.status == 0 and (kept["power"], kept["neighbours"]) == (3, 8)


def test_overrides_behind_cfg_were_unrecognized_arguments():
    said = knock(
        COMMANDS["train"].run,
        "train",
        ["model=idw", "--cfg", "job", "dataset=own", "model.power=3"],
    )
    assert said.status == 0 and {"  power: 3", "  name: own"} < set(said.out)


def test_trainer_defaults_in_code_are_those_of_the_configuration():
    trainer = OmegaConf.to_container(compose().trainer)
    del trainer["_target_"]
    lightning = {name: one.default for name, one in signature(Trainer).parameters.items()}
    assert {**lightning, **DEFAULTS.keywords} == {**lightning, **trainer}


@pytest.mark.parametrize("option", ["max_epochs=3", "max_time=00:00:01:00", "profiler=simple"])
def test_options_of_the_trainer_need_no_plus(option):
    """`trainer.max_epochs=3`: no such setting."""
    name, _, value = option.partition("=")
    assert str(compose(f"trainer.{option}").trainer[name]) == value


def test_the_paper_leaves_nothing_to_auto():
    config = compose("paper=gsparc")
    settings = build(config.model).settings
    values = [config.init.name, settings.emission.activation, settings.emission.encoding.kind]
    assert "auto" not in [*values, settings.emission.init_bias]
    assert len(config.model.guesses) > 5


def test_guesses_of_callbacks_that_are_left_out_were_said():
    """`densification from step none to none every none`."""
    given = "paper=gsparc", "callbacks.densify=null", "callbacks.reset=null"
    whole, without = (build(compose(*options).model).guesses for options in (given[:1], given))
    assert (
        len(whole) == 13
        and len(without) == 9
        and not any("None" in guess for guess in [*whole, *without])
    )
