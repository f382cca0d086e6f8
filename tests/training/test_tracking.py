"""Dashboards get pictures and the final table; a logger that shows neither is left alone."""

import numpy as np
import pytest
from PIL import Image

from gsparc.training.tracking import picture, table, tensorboard_logger


class Records:
    """A logger of Weights & Biases as far as we speak to it."""

    def __init__(self):
        self.said = []

    def log_image(self, name, images, step):
        self.said.append((name, images, step))

    def log_table(self, name, columns, data):
        self.said.append((name, columns, data))


@pytest.fixture
def file(tmp_path):
    Image.fromarray(np.full((4, 6, 3), 90, np.uint8)).save(tmp_path / "a.png")
    return tmp_path / "a.png"


def test_weights_and_biases_gets_files_and_tables(file):
    logger = Records()
    picture([logger], "predictions", file, 7)
    table([logger], "results", ["method", "dB"], [["gp", "3.1"]])
    assert logger.said == [("predictions", [str(file)], 7), ("results", ["method", "dB"], [["gp", "3.1"]])]


def test_tensorboard_gets_pixels_and_markdown(file, tmp_path):
    pytest.importorskip("tensorboard", reason="TensorBoard is not installed: the extra tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logger = tensorboard_logger(str(tmp_path))
    picture([logger], "predictions", file, 7)
    table([logger], "results", ["method", "dB"], [["gp", "3.1"]])
    logger.finalize("success")
    found = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    (image,) = found.Images("predictions")
    assert (image.step, image.height, image.width) == (7, 4, 6)
    (text,) = found.Tensors("results/text_summary")
    assert b"| gp | 3.1 |" in text.tensor_proto.string_val[0]


def test_other_loggers_are_left_alone(file):
    logger = type("CSV", (), {"experiment": object()})()
    picture([logger], "predictions", file, 7)
    table([logger], "results", ["method"], [["gp"]])
    assert not vars(logger)
