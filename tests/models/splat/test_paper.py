"""`paper=gsparc` is the rendered field, on every kind, or an error in one line."""

import numpy as np
import pytest
import torch
from campaigns import brief, channels, compose, powers, spectra
from contexts import short
from scenes import fold_of

from gsparc.datasets.load import load as load_data
from gsparc.models.registry import build
from gsparc.models.splat.method import LearnedField
from gsparc.training.effort import Effort

MAKERS = {
    "spectra": spectra,
    "spectra, receiver moves": lambda path: spectra(path, moving="rx"),
    "one tone": lambda path: channels(path, shape="S"),
    "tones, transmitter moves": lambda path: channels(path, moving="tx", shape="SK"),
    "antennas and tones": channels,
    "powers": powers,
}
SIGNED = "model.emission.activation=signed_sigmoid"


def prepared(file, *more: str, paper: str = "gsparc"):
    data = load_data({"name": "own", "file": str(file)})
    words = [word for word in brief(file, *more) if not word.startswith("model.effects")]
    method = build(compose(*words, f"paper={paper}", "model.field.count=30").model).create_for(data)
    return method, data


@pytest.mark.parametrize("model", ["gsparc", "splat"])
@pytest.mark.parametrize("name", MAKERS)
def test_the_paper_was_another_method_under_its_name(tmp_path, name, model):
    """`paper=gsparc` on Argos was `UplinkField`."""
    method, data = prepared(MAKERS[name](tmp_path / "own.npz"), f"model={model}")
    assert type(method) is LearnedField and method.label == "gsparc-paper"
    fold, context = fold_of(data), short(tmp_path, 3)
    if name == "powers":
        with pytest.raises(
            ValueError, match=r"spectra and channels .* here the target is powers: take model"
        ):
            method.fit(data, fold, context)
        return
    method.fit(data, fold, context)
    batch = data.batch(np.arange(4))
    answers = method.predict(batch)
    assert answers.mean.shape == batch.target.shape and torch.isfinite(answers.mean).all()
    numbers = int(np.prod(batch.target.shape[1:])) if data.site.kind == "csi" else 1
    assert method.fitted_model().emission.weight2.shape[2] == 2 * numbers


def test_channels_of_a_sigmoid_cannot_be_negative(tmp_path, caplog):
    file = channels(tmp_path / "own.npz", shape="SK")
    for words, least in (((), 0.0), ((SIGNED,), -np.inf)):
        method, data = prepared(file, *words)
        method.fit(data, fold_of(data), short(tmp_path, 3))
        mean = torch.view_as_real(method.predict(data.batch(np.arange(20))).mean)
        assert (mean.min() >= 0) == (least == 0)
    assert sum("signed_sigmoid is the smallest change" in line for line in caplog.messages) == 1


def test_the_program_s_field_differs_from_the_text_s(tmp_path):
    file = spectra(tmp_path / "own.npz")
    text, _ = prepared(file)
    code, data = prepared(file, "model.field.spacing=3", paper="gsparc_code")
    assert (
        text.settings.attenuation.inverse_distance
        and not code.settings.attenuation.inverse_distance
    )
    assert (text.settings.emission.hidden, code.settings.emission.hidden) == (16, 32)
    assert code.init.name == "grid"
    assert code.describe_fit(data, Effort(), 7) == "7 gradient steps from init=grid"


def test_the_console_says_how_a_fit_goes(tmp_path):
    data = load_data({"name": "own", "file": str(spectra(tmp_path / "own.npz"))})
    method = build(compose(*brief(tmp_path / "own.npz")).model)
    assert method.describe_fit(data, Effort()).startswith(
        "image_process, closed form, then at most 60 gradient"
    )
    assert method.describe_fit(data, Effort(), 5).endswith(
        "then 5 gradient steps; the paper's recipe: paper=gsparc"
    )


def test_a_grid_of_gaussians_was_left_to_image_sources(tmp_path):
    """`model=gsparc init=grid` on channels chose what has no grid."""
    data = load_data({"name": "own", "file": str(channels(tmp_path / "own.npz"))})
    for start in ("uniform", "grid"):
        method = build(compose(*brief(tmp_path / "own.npz", f"init={start}")).model)
        assert method.describe_fit(data, Effort(), 5).startswith(
            f"image_process, 5 gradient steps from init={start}"
        )
