"""Commands: Hydra around a task, an error in one clear line,
an exit status that tells the truth.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial, wraps
from importlib import resources
from io import StringIO
from pathlib import Path
from types import FrameType
from typing import Any

import hydra
import yaml
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from gsparc.base.errors import DataError
from gsparc.base.files import check_yaml, list_causes
from gsparc.base.instantiate import GROUPS, import_target, plugin_node, plugins
from gsparc.evaluation import console
from gsparc.evaluation.console import (
    CONFIGS,
    FULL_ERROR,
    config_folder,
    error_in_one_line,
    list_choices,
)
from gsparc.models import registry
from gsparc.runs.run_lock import InUse, release_folders
from gsparc.simulate.scenes.shipped import list_shipped_scenes, shipped_scene_settings
from gsparc.training.effort import refuse_seconds

log = logging.getLogger(__name__)


def offer_plugins() -> None:
    """Make every plugin a choice of its config group, with its settings and their defaults.

    One that cannot be imported is warned of and left out.
    """
    for group in GROUPS:
        for name, path in plugins(group).items():
            try:
                defaults = plugin_node(group, name)
            except DataError as error:
                log.warning("plugin %s (%s) is left out: %s", name, path, error)
                continue
            if hasattr(import_target(path), "plain_place"):
                log.warning(
                    "plugin %s: no baseline; plain_place is called baseline_order now", name
                )
            shared: dict[str, Any] = {"name": name, "batch_size": 16} if group == "dataset" else {}
            if group == "model" and "seed" in defaults:
                # What a plugin draws follows the seed of the run.
                shared["seed"] = "${seed}"
            node = {**defaults, **shared}
            ConfigStore.instance().store(name=name, group=group, node=node, provider="plugin")


def offer_scenes() -> None:
    """Make every scene that comes with Sionna a choice of `scene=`, and `scene=help`,
    which lists them.
    """
    written = resources.files("gsparc.conf") / "scene"
    # Scenes that have a file of ours keep its settings.
    bare = [name for name in list_shipped_scenes() if not (written / f"{name}.yaml").is_file()]
    nodes = {name: shipped_scene_settings(name) for name in bare}
    for name, node in {**nodes, "help": {"name": "help"}}.items():
        ConfigStore.instance().store(name=name, group="scene", node=node, provider="sionna")


# Of an interrupt inside `logging`; writing a log may wait for its reader
RETRY_S, MOST_RETRIES = 0.01, 100
# Options of Hydra that a value follows, which is no override.
VALUED = (
    "--cfg -c",
    "--package -p",
    "--config-path -cp",
    "--config-name -cn",
    "--config-dir -cd",
    "--experimental-rerun",
)
LAUNCHERS = ("submitit.", "joblib.externals.loky.", "ray.")  # where their errors are defined


class _Failed(BaseException):
    """Carries an error past Hydra, which would add a line of its own."""

    def __init__(self, error: Exception) -> None:
        super().__init__(str(error))
        self.error = error


def run(task: Callable[[DictConfig], object], config: str) -> None:
    """Run `task` under Hydra with `conf/<config>.yaml` and the command line's overrides.

    An error is one line on stderr and exit status 1 (130 after an interrupt); with
    `HYDRA_FULL_ERROR=1` the traceback comes instead.

    Args:
        task: called with the composed configuration.
        config: name of the primary configuration.
    """
    offer_plugins()
    if config == "simulate":
        offer_scenes()
    if config == "train" and any(word.startswith("ckpt_path=") for word in sys.argv):
        from gsparc.runs.continued import add_settings_of_run  # which brings torch

        sys.argv[1:] = add_settings_of_run(sys.argv[1:])
    before = os.environ.get(FULL_ERROR)
    os.environ[FULL_ERROR] = "1"  # Hydra then raises instead of printing and exiting by itself
    options, words = _read_options(sys.argv[1:])
    # Hydra takes overrides in one piece alone, which options would cut.
    sys.argv[1:] = words + [word for word in sys.argv[1:] if word not in words]
    main = hydra.main(version_base="1.3", config_path=CONFIGS, config_name=config)(_bypass(task))
    logging.raiseExceptions = False  # a log that a full disk cannot take: results say so themselves
    interrupts: list[int] = []
    for said in (console.ConsoleHandler.read, console.ConsoleHandler.before):
        said.clear()
    try:
        with _noting(interrupts):
            refuse_seconds(dict(word.lstrip("+").split("=", 1) for word in words if "=" in word))
            for folder in (options.config_dir, options.config_path):
                check_yaml(folder)
            if options.cfg and options.multirun:
                raise ValueError(
                    "--cfg shows one job: leave out -m, and give one value of each setting"
                )
            if options.cfg in ("job", "all"):
                _show_whole(main)
            else:
                main()
    except BrokenPipeError:  # of Hydra's own lists: gsparc/__main__.py ends quietly
        raise
    except (_Failed, InUse, KeyboardInterrupt, Exception) as failure:
        error = failure.error if isinstance(failure, _Failed) else failure
        interrupted = _began_as_interrupt(error)
        if before == "1" and isinstance(error, Exception) and not interrupted:
            raise error from error.__cause__
        message = _message_of(error)
        if interrupts and not interrupted:
            message = f"interrupted: {message}"
        Console(stderr=True, soft_wrap=True).print(
            f"error: {message}", markup=False, highlight=False, style="red"
        )
        sys.exit(130 if interrupted or interrupts else 1)
    finally:
        logging.raiseExceptions = True
        release_folders()
        os.environ.pop(FULL_ERROR)
        if before is not None:
            os.environ[FULL_ERROR] = before


def _read_options(words: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """Options of Hydra, of which some are looked at before it runs,
    and the overrides among words.
    """
    parser = argparse.ArgumentParser(add_help=False)
    for name in VALUED:
        parser.add_argument(*name.split())
    parser.add_argument("--info", "-i", nargs="?")
    parser.add_argument("--multirun", "-m", action="store_true")
    options, rest = parser.parse_known_args(words)
    return options, [word for word in rest if not word.startswith("-")]


def _show_whole(main: Callable[[], object]) -> None:
    """What `--cfg` prints, with those settings of the model that its file leaves to its class."""
    with redirect_stdout(StringIO()) as output:
        main()
    config = DictConfig(OmegaConf.create(output.getvalue()))
    # The former with `--package model`
    node = config if "_target_" in config else config.get("model")
    if isinstance(node, DictConfig):
        registry.fill_defaults(node)
    sys.stdout.write(OmegaConf.to_yaml(config))


@contextmanager
def _noting(interrupts: list[int]) -> Iterator[None]:
    """Within, Ctrl-C also leaves its number:
    compiled code may swallow it and raise an error of its own.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield  # nothing arrives here, or Ctrl-C is ignored
        return

    later: list[threading.Timer] = []

    def noted(signum: int, frame: FrameType | None) -> object:
        # Every thread needs the lock of `logging`, which would be left taken:
        # tried again when it is out.
        if len(later) < MOST_RETRIES and _in_logging(frame):
            again = partial(signal.pthread_kill, threading.get_ident(), signum)
            later.append(threading.Timer(RETRY_S, again))
            later[-1].start()
            return None
        interrupts.append(signum)
        return before(signum, frame)

    signal.signal(signal.SIGINT, noted)
    try:
        yield
    finally:
        for timer in later:
            timer.cancel()
        signal.signal(signal.SIGINT, before)


def _in_logging(frame: FrameType | None) -> bool:
    while frame is not None and frame.f_code.co_filename != logging.__file__:
        frame = frame.f_back
    return frame is not None


def _began_as_interrupt(error: BaseException | None) -> bool:
    """A clean-up that meets what Ctrl-C left half done raises an error
    of its own over the interrupt.
    """
    return any(isinstance(cause, KeyboardInterrupt) for cause in list_causes(error))


def _multirun_advice() -> str:
    """How all jobs of a multirun go on, in the same folder."""
    hydra_config = HydraConfig.get()
    told = any(word.startswith("hydra.sweep.dir=") for word in hydra_config.overrides.hydra)
    again = (
        "the same command"
        if told
        else (f"the same command with hydra.sweep.dir={hydra_config.sweep.dir}")
    )
    begun = "unfinished ones resume from last.ckpt, or start again"
    return f"interrupted; finished jobs are kept: {again} goes on; {begun}"


def _message_of(error: BaseException) -> str:
    """One line; of a launcher whose job has died, with what to do."""
    if isinstance(error, InUse | KeyboardInterrupt):
        return str(error) or "interrupted"
    if _began_as_interrupt(error):
        return "interrupted"
    if type(error).__module__.startswith(LAUNCHERS):
        advice = "what is done is kept, the same command goes on with the rest"
        return f"a job was lost ({error_in_one_line(error)}); {advice}"
    return error_in_one_line(error)


def help_text(answers: str, config: str) -> str:
    """Return what `--help` says: what it `answers`, settings with comments, choices of groups.

    Read from files: Hydra's own list of all values has no comments.
    """
    offer_scenes()
    files, texts, groups = [config], [answers], dict[str, Any]()
    for name in files:
        text = (config_folder() / f"{name}.yaml").read_text(encoding="utf-8")
        texts.append(text.partition("\nhydra:")[0].rstrip())
        for default in yaml.safe_load(text).get("defaults", ()):
            if isinstance(default, dict):
                groups |= default
            elif "/" not in default and default != "_self_":  # all of another command's settings
                files.append(default)
    if "kind" in groups:  # settings of the command itself
        kinds = [word.partition("=")[2] for word in sys.argv if word.startswith("kind=")]
        file = config_folder() / "kind" / f"{[groups['kind'], *kinds][-1]}.yaml"
        texts += (
            [f"# {file.stem}\n{file.read_text(encoding='utf-8').rstrip()}"] if file.exists() else []
        )
    named = {
        group: {*list_choices(group), *(plugins(group) if group in GROUPS else ())}
        for group in groups
    }
    texts.append(
        "\n".join(f"  {group}={'|'.join(sorted(names))}" for group, names in named.items())
    )
    return "\n\n".join(texts) + (
        f"\n\n`gsparc {config} key=value ... --cfg job` shows every value.\n"
    )


def _complete(config: DictConfig) -> None:
    """Add the settings of a model that its file leaves to its class,
    also to what Hydra has written.
    """
    registry.fill_defaults(config.model)
    hydra_config = HydraConfig.get()
    if hydra_config.output_subdir is not None:
        OmegaConf.save(
            config, Path(hydra_config.runtime.output_dir, hydra_config.output_subdir, "config.yaml")
        )


def _refuse_folder_of_one_run() -> None:
    """Raise ValueError where jobs of a multirun are given the folder of one run,
    which Hydra ignores.
    """
    own = HydraConfig.get()
    names = {word.lstrip("+").partition("=")[0] for word in own.overrides.hydra}
    if own.mode == RunMode.MULTIRUN and "hydra.run.dir" in names and "hydra.sweep.dir" not in names:
        raise ValueError(
            "hydra.run.dir is the folder of one run; these are several: say hydra.sweep.dir=FOLDER"
        )


def _bypass(task: Callable[[DictConfig], object]) -> Callable[[DictConfig], object]:
    @wraps(task)
    def wrapped(config: DictConfig) -> object:
        logging.captureWarnings(True)  # now that there is a log
        try:
            _refuse_folder_of_one_run()
            if "model" in config:
                _complete(config)
            return task(config)
        except KeyboardInterrupt as stopped:
            if HydraConfig.get().mode == RunMode.RUN:
                raise
            # A job's own is of that job alone
            raise KeyboardInterrupt(_multirun_advice()) from stopped
        except Exception as error:
            if HydraConfig.get().mode == RunMode.RUN:
                raise _Failed(error) from error
            raise  # in a sweep Hydra names the job that failed
        finally:
            logging.captureWarnings(False)

    return wrapped
