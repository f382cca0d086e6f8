"""What misses rows left out by more than what is simpler answers nothing;
what is right is never refused.
"""

from dataclasses import replace

import numpy as np
import torch
from boxes import room_of_spectra
from closed import fitted_to
from scenes import fold_of

from gsparc.base.errors import Severe
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models import checkpoint, fitting, loading, sanity
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.baselines.mean import Mean
from gsparc.models.mixture.methods import Powers
from gsparc.models.per_station import PerStation
from gsparc.models.powers.together import learning
from gsparc.prediction.left_out import predict_rows
from gsparc.processes.kernel import Kernel
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext


def lying_still() -> Measurements:
    """Levels of three stations, 4 dB of noise, about a street and, half of them,
    where a phone lay still.
    """
    rng = np.random.default_rng(1)
    walk = np.c_[rng.uniform(0, 200, (40, 2)), np.full(40, 1.5)]
    spot = walk[0] + np.c_[rng.normal(0, 0.02, (40, 2)), rng.normal(0, 15, 40)]
    place, posts = (
        np.concatenate([walk, spot]),
        np.array([[0.0, -3e3, 20], [3e3, 0, 20], [90, 4e3, 20]]),
    )
    far = np.linalg.norm(place[:, None] - posts, axis=-1)
    levels = -30 * np.log10(far) + rng.normal(0, 4, far.shape)
    return from_arrays({"rx_position": place, "station_position": posts, "rssi_db": levels})


def walk_into_a_corner(monkeypatch) -> None:
    """Have all stations alike choose long lengths and no noise,
    as a slope that was NaN once did.
    """
    right = learning._fit_common_kernel

    def wrong(*given):
        kernel, priors = right(*given)
        long = Kernel.from_lengths((300.0, 900.0), (0.5, 0.5), 1e-6, kernel.amplitude)
        return long, {number: replace(prior, kernel=long) for number, prior in priors.items()}

    monkeypatch.setattr(learning, "_fit_common_kernel", wrong)


def fitted(folder, data, fold):
    return fitting.fit_or_resume(
        PerStation(Powers()), data, fold, FitContext(folder, stations="together")
    )


def test_a_fit_in_a_corner_predicted_47_dbm_where_minus_86_was_heard(monkeypatch, tmp_path):
    """Nothing asked whether it predicts what it learned from better than the mean
    of each station does.
    """
    data = lying_still()
    fold = fold_of(data)
    sane, report = fitted(tmp_path, data, fold)
    assert not any(isinstance(note, Severe) for note in report.notes)
    walk_into_a_corner(monkeypatch)
    method, report = fitted(tmp_path, data, fold)
    (text,) = (note for note in report.notes if isinstance(note, Severe))
    assert "answers nothing: at " in text and text.endswith("; the plain mean answers")
    mean = PerStation(Mean())
    mean.fit(data, fold, FitContext(tmp_path, stations="each"))
    said, plain = (predict_rows(one, data, fold.test).mean for one in (method, mean))
    assert torch.equal(said, plain) and not torch.equal(
        said, predict_rows(sane, data, fold.test).mean
    )

    checkpoint.save(
        tmp_path / "model.ckpt", method, extra=fitting.run_extra(report, data, fold, FitContext())
    )
    stored = checkpoint.read(tmp_path / "model.ckpt")
    assert text in stored.extra["notes"]
    again = loading.rebuild_method(Powers(), stored)
    assert torch.equal(predict_rows(again, data, fold.test).mean, said)


def test_what_is_right_is_not_refused(campaign, folds, tmp_path):
    fold = folds(60).folds[0]
    method, report = fitting.fit_or_resume(
        Powers(), campaign("rssi", 60), fold, FitContext(tmp_path)
    )
    assert not any(isinstance(note, Severe) for note in report.notes) and not isinstance(
        method, Mean
    )


def test_a_mixture_does_without_a_member_that_is_worse_than_the_simpler_one():
    data, rows = room_of_spectra(), np.arange(40)
    members = [fitted_to(GaussianProcess(), data, rows)[0] for _ in range(2)]
    members[1].mean, members[1].count_gaussians = members[1].mean + 0.3, 5
    both = Powers()
    both.members, both.weights, both.started = members, (0.25, 0.75), "process+bearings"
    kept, texts = sanity._refuse_members(
        [(0.25, members[0]), (0.75, members[1])], data, Fold(rows, np.arange(40, 60), rows[:0])
    )
    both.keep_members(kept)
    assert both.members == members[:1] and both.weights == (1.0,) and both.started == "process"
    assert "times that of gp" in texts[0]
