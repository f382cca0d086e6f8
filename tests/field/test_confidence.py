import torch

from gsparc.field.confidence import Confidence, ConfidenceSettings, weighted_loss
from gsparc.field.encoding import EncodingSettings, PositionEncoding

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])


def confidence(seed: int = 0, **more) -> Confidence:
    torch.manual_seed(seed)
    return Confidence(ConfidenceSettings(**more), PositionEncoding(EncodingSettings("raw"), BOX))


def test_the_best_confidence_is_alpha_over_loss():
    """Of the paper's loss, which hard_cases/test_confidence_overflow.py compares
    with its formula.
    """
    g = torch.linspace(-9, 9, 20001)
    for loss in (0.01, 0.05, 0.1):
        best = 1 + g[weighted_loss(torch.tensor(loss), g, 0.3).argmin()].exp()
        assert abs(float(best) - 0.3 / loss) < 0.02 * 0.3 / loss
    # Above alpha the floor C = 1 is best: a poor sample still counts once.
    assert weighted_loss(torch.tensor(0.5), g, 0.3).argmin() == 0


def test_one_calibration_position_gives_a_range():
    sure = confidence()
    sure.store_range(torch.zeros(1, 3))
    assert torch.isfinite(sure.normalised_confidence(torch.randn(5, 3))).all()


def test_far_from_what_was_measured_nothing_is_sure():
    near, far = torch.rand(200, 3) * 2 - 1, torch.randn(500, 3) * 300
    for seed in range(5):
        sure = confidence(seed)
        sure.store_range(near)
        assert (
            sure.normalised_confidence(far).median()
            < 1e-6
            < sure.normalised_confidence(near).median()
        )
