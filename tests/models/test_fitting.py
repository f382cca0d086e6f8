"""Runs of many parts: finished ones are taken, none for another,
and what is said of how to go on is true.
"""

import numpy as np
import pytest
from posts import POSTS, heard
from refusals import refused
from scenes import fold_of

from gsparc.base import executor
from gsparc.models import fitting
from gsparc.models.baselines.nearest import Nearest
from gsparc.models.per_station import PerStation
from gsparc.models.station_sites import station_site
from gsparc.training.context import FitContext


class Resumable(Nearest):
    """Counts its fits, and is interrupted in the one whose turn it is."""

    resumable = takes_effort = True
    fits, stop_at = 0, 0

    def fit(self, data, fold, context):
        """See `Method.fit`."""
        Resumable.fits += 1
        if Resumable.fits == Resumable.stop_at:
            raise KeyboardInterrupt("training was interrupted; there is no checkpoint yet")
        return super().fit(data, fold, context)


@pytest.fixture()
def town():
    data = heard(posts=POSTS[:3])
    return data, fold_of(data)


def fitted(town, folder, stop_at=0, **more):
    Resumable.fits, Resumable.stop_at = 0, stop_at
    method = PerStation(Resumable())
    method.fit(*town, FitContext(folder, **more))
    return method


def test_stations_were_mixed_up_and_done_again_by_a_resumed_run(town, tmp_path, caplog):
    """Stopped at antenna 13, "go on with" its file began again at antenna 0
    with what 13 had found.
    """
    with pytest.raises(KeyboardInterrupt) as stopped:
        fitted(town, tmp_path / "run", stop_at=3)
    said = str(stopped.value)
    assert said.startswith("station 3 of 3 was interrupted, 2 are finished; go on with ckpt_path=")
    left = said.partition("ckpt_path=")[2]
    # The run, or a file in a part
    for resume in (left, tmp_path / "run" / "station2" / "last.ckpt"):
        again = fitted(town, tmp_path / "on", resume=type(tmp_path)(resume))
        assert Resumable.fits == 1
    whole, batch = fitted(town, tmp_path / "whole"), town[0].batch(town[1].test)
    assert (again.predict(batch).mean == whole.predict(batch).mean).all()
    # It can be gone on from, too
    assert len(list((tmp_path / "on").glob("station*/model.ckpt"))) == 3


def test_a_folder_of_stations_that_were_finished_was_not_gone_on_from(town, tmp_path):
    """Of a run's folder only its own `last.ckpt` was taken,
    which stations have in folders of their own.
    """
    fitting.fit_or_resume(PerStation(Resumable()), *town, FitContext(tmp_path / "run"))
    Resumable.fits = 0
    fitting.fit_or_resume(
        PerStation(Resumable()), *town, FitContext(tmp_path / "on", resume=tmp_path / "run")
    )
    assert Resumable.fits == 0


def test_a_part_is_not_taken_for_another(town, tmp_path):
    data = town[0]
    fitted(town, tmp_path / "run")
    one, two = (
        data.subset(np.flatnonzero(data.station == t), station_site(data.site, t)) for t in (0, 1)
    )
    assert one.site.sha256 != two.site.sha256 != data.site.sha256
    (tmp_path / "run" / "station1" / "model.ckpt").rename(
        tmp_path / "run" / "station0" / "model.ckpt"
    )
    refused("was trained with other data", fitted, town, tmp_path / "on", resume=tmp_path / "run")
    refused(r"seed=0 \(here 1\)", fitted, town, tmp_path / "on", resume=tmp_path / "run", seed=1)


def test_a_run_that_begins_anew_leaves_no_parts_of_the_one_before(town, tmp_path):
    fitted(town, tmp_path, seed=1)
    with pytest.raises(KeyboardInterrupt):
        fitted(town, tmp_path, stop_at=2)
    assert [path.parent.name for path in tmp_path.glob("station*/model.ckpt")] == ["station0"]


def test_the_log_did_not_say_which_of_42_antennas_it_was_nor_what_was_left(
    town, tmp_path, caplog, monkeypatch
):
    monkeypatch.setattr(executor, "SAY_S", 0.0)
    monkeypatch.setattr(executor, "LINES", 100)
    caplog.set_level("INFO", "gsparc")
    fitted(town, tmp_path, effort=2.0)
    lines = [one.getMessage().partition(", about")[0] for one in caplog.records]
    said = [line for line in lines if "station" in line]
    left = [f"{i} of 3 stations of {Resumable.name}" for i in (1, 2)]
    own = [f"{Resumable.name}: station {i} of 3 ({i - 1})" for i in (1, 2, 3)]
    assert said == [own[0], left[0], own[1], left[1], own[2]]


def test_a_third_of_the_log_was_numbers_of_stations_fitted_in_a_second(
    town, tmp_path, caplog, monkeypatch
):
    """`station 17 of 21: 212`, of no method, 147 of 440 lines."""
    monkeypatch.setattr(Resumable, "resumable", False)
    caplog.set_level("INFO", "gsparc")
    fitted(town, tmp_path)
    assert not [one for one in caplog.messages if "station 1 of 3" in one]
