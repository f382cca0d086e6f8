"""Errors in one line, and the log as the console shows it."""

import io
import logging

import pytest
from hydra import compose, initialize_config_module

from gsparc.base.errors import Severe
from gsparc.datasets.own import Own
from gsparc.evaluation.console import (
    ConsoleHandler,
    config_folder,
    error_in_one_line,
    last_warnings,
    mark_logged_warnings_shown,
)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (
            KeyError("x"),
            "KeyError: 'x' (HYDRA_FULL_ERROR=1 shows where)",
        ),  # a bug is named by its type
        (ValueError("first line\nsecond"), "first line"),
        (ValueError(), "ValueError:  (HYDRA_FULL_ERROR=1 shows where)"),
        # It was `[Errno 2] No such file or directory: '/proc/x'`.
        (
            FileNotFoundError(2, "No such file or directory", "/proc/x"),
            "/proc/x: No such file or directory",
        ),
    ],
)
def test_an_error_is_one_line(error, line):
    assert error_in_one_line(error) == line


def test_an_equals_sign_in_a_list_was_not_understood_without_saying_why():
    text = "+splits.squares={choose: [split=blocks, split.side_m=1], draws: 3}"
    with (
        initialize_config_module("gsparc.conf", version_base="1.3"),
        pytest.raises(Exception) as error,
    ):
        compose("compare", overrides=[text])
    assert error_in_one_line(error.value).endswith('; inside brackets quote it: "split=..."')
    quoted = text.replace("split=blocks", '"split=blocks"').replace(
        "split.side_m=1", '"split.side_m=1"'
    )
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        found = compose("compare", overrides=[quoted])
    assert found.splits.squares.choose == ["split=blocks", "split.side_m=1"]
    example = (config_folder() / "compare.yaml").read_text()
    assert quoted in example


def test_evaluate_said_how_every_column_is_read(tmp_path, caplog):
    """28 lines of columns, of the file and of the one that was learned from,
    stood before its table.
    """
    (tmp_path / "drive.csv").write_text(
        "x,y,rsrp_dbm\n" + "".join(f"{i},{i * i},{-60 - i}\n" for i in range(9))
    )
    first, again = Own(tmp_path / "drive.csv"), Own(tmp_path / "drive.csv")
    with caplog.at_level(logging.INFO):
        first.measurements  # noqa: B018 (read)
        assert "column 'rsrp_dbm' taken as rssi_db" in caplog.text
        caplog.clear()
        again.told = first.notes
        again.measurements  # noqa: B018
    assert not [one for one in caplog.records if one.levelno < logging.WARNING]


def test_a_setting_of_a_launcher_that_was_not_chosen_had_no_hint():
    with (
        initialize_config_module("gsparc.conf", version_base="1.3"),
        pytest.raises(Exception) as error,
    ):
        compose("train", overrides=["hydra.launcher.n_jobs=2"])
    assert error_in_one_line(error.value).endswith("say hydra/launcher=joblib, too, or ray")


def test_twelve_stations_wrote_two_hundred_lines(monkeypatch, caplog):
    """A default run of a city filled five screens: notes of each station,
    sixty warnings of a kind.
    """
    screen = ConsoleHandler(["gsparc.models"], io.StringIO())
    monkeypatch.setattr(logging.getLogger(), "handlers", [screen])
    caplog.set_level(logging.INFO)
    for station in range(12):
        logging.getLogger("gsparc.models.per_station").warning("%g s are too few", 5 - station / 7)
        logging.getLogger("gsparc.models.per_station").warning(
            "data/a.npz: no level of station s%d", station
        )
        logging.getLogger("gsparc.models.per_station").info("station %d of 12", station)
    for _ in range(2):  # the same spectrum each time: it was counted as two warnings
        logging.getLogger("gsparc.models.vectors").warning(
            "1 spectrum cannot come from this array (see it)"
        )
    logging.getLogger("gsparc.modelling").warning("data/a.npz: 3 places were measured twice")
    logging.getLogger("gsparc.modelling").info("fitting")
    assert screen.stream.getvalue().splitlines() == [
        "warning: 5 s are too few",
        "warning: data/a.npz: no level of station s0",
        "warning: 1 spectrum cannot come from this array (see it)",
        "warning: data/a.npz: 3 places were measured twice",
        "fitting",
    ]
    assert last_warnings("train.log") == ["22 more warnings in train.log"]


def test_what_a_run_warned_of_is_not_said_by_who_asks_its_model(tmp_path, monkeypatch):
    monkeypatch.setattr(ConsoleHandler, "before", set())
    (tmp_path / "train.log").write_text(
        "[2026-01-01 10:00:00,000][gsparc.datasets][WARNING] - /data/a.csv: 3 wild rows\n"
    )
    mark_logged_warnings_shown(tmp_path / "fold0")
    monkeypatch.setattr(logging.getLogger(), "handlers", [ConsoleHandler([], io.StringIO())])
    (screen,) = logging.getLogger().handlers
    log = logging.getLogger("gsparc.datasets.campaign")
    log.warning("%s: %s", "/moved/a.csv", "3 wild rows")
    log.warning("%s: %s", "/moved/a.csv", "4 rows too far")
    assert screen.stream.getvalue() == "warning: /moved/a.csv: 4 rows too far\n"


def test_a_wrong_convention_was_said_once_far_above_the_table(monkeypatch):
    screen = ConsoleHandler([], io.StringIO())
    monkeypatch.setattr(logging.getLogger(), "handlers", [screen])
    log = logging.getLogger("gsparc.datasets.campaign")
    log.warning("%s: %s", "a.npz", Severe("conjugate=true mends it"))
    log.warning("%s: %s", "a.npz", "3 wild rows")
    # Untrue for powers given as losses: figures of nearest, idw, kriging and mean stayed the same.
    assert last_warnings() == ["this may change the figures above: a.npz: conjugate=true mends it"]


def test_jobs_of_a_sweep_said_again_how_columns_are_read(monkeypatch):
    """Twice in each job, and after the last by the path: a file is read more than once."""
    monkeypatch.setattr(ConsoleHandler, "read", set())
    said = []
    for text in ("a.csv: columns x", "data/a.csv: columns x", "b.csv: columns x"):
        record = logging.LogRecord("gsparc.datasets.campaign", logging.INFO, "", 0, text, (), None)
        said.append(ConsoleHandler([], io.StringIO()).filter(record))
    assert said == [True, False, True]
