"""Stations learned together or each, where nobody says."""

from dataclasses import replace

import numpy as np
import pytest
from posts import POSTS, distances, heard
from scenes import fold_of

from gsparc.data.split_settings import SplitSettings
from gsparc.models.gsparc import Gsparc
from gsparc.models.mixture import each_or_together
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.per_station import PerStation
from gsparc.models.registry import method_class
from gsparc.training.context import FitContext


def of_one_law():
    """Powers at four stations, with noise, and their fold."""
    noise = np.random.default_rng(0).normal(size=(40, 4))
    data = heard(40, rssi_db=lambda far: -30 * np.log10(far) + noise)
    return data, fold_of(data)


def test_powers_of_few_rows_are_learned_together_without_a_trial():
    how, why = Gsparc().choose_stations(*of_one_law(), FitContext())
    assert how == "together" and "law" in why


def test_rows_beyond_one_factor_are_learned_by_station(monkeypatch):
    monkeypatch.setattr(each_or_together, "ONE_FACTOR", 50)
    how, why = Gsparc().choose_stations(*of_one_law(), FitContext())
    assert how == "each" and why.endswith("rows are more than one factor holds (50)")


def test_stations_that_nobody_heard_are_answered_by_what_all_share():
    data, split = of_one_law()[0], SplitSettings("stations", leave_out=1)
    fold = fold_of(data, name="stations", leave_out=1)
    assert Gsparc().choose_stations(data, fold, FitContext(split=split))[0] == "together"


def test_channels_of_42_antennas_were_learned_one_after_another(tmp_path, monkeypatch, caplog):
    """Over 30 minutes, where one of all took 29 s and had half the error;
    plain methods stay as they were.
    """
    caplog.set_level("INFO", "gsparc")
    channels = np.exp(-2j * np.pi * 9.2e8 / 3e8 * distances(30))
    data = heard(30, csi=channels, frequency_hz=np.array(9.2e8))
    fold = fold_of(data)
    fits = []
    monkeypatch.setattr(Mixture, "fit", lambda self, *given: fits.append(given) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        PerStation(Gsparc()).fit(data, fold, FitContext(tmp_path))
    assert len(fits) == 1 and len(fits[0][0]) == len(data)
    assert "stations=auto -> together: channels" in caplog.text
    plain = PerStation(method_class("nearest")())
    plain.fit(data, fold, FitContext(tmp_path))
    assert len(dict(plain)) == len(POSTS) and caplog.text.count("stations=auto") == 1
    each = PerStation(Gsparc())
    with pytest.raises(ZeroDivisionError):
        each.fit(data, fold, replace(FitContext(tmp_path), stations="each"))
    assert len(fits) == 2
