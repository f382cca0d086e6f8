"""Error rates as they are drawn."""

import numpy as np
import pandas as pd

from gsparc.apps.link import pictures
from gsparc.processes.uncertainty import binomial_interval


def test_points_without_any_failed_block_were_drawn_as_rates(tmp_path, monkeypatch):
    """0 of 480 stood at 3e-4, where curves met, as if it had been measured."""
    figures = []
    monkeypatch.setattr(pictures, "save", lambda figure, path: figures.append(figure))
    errors = np.array([240, 24, 0])
    curve = pd.DataFrame(
        {"bler": errors / 480, "errors": errors, "blocks": 480, "ber": [0.1, 0.01, 0.0]},
        index=[0.0, 2.0, 4.0],
    )
    pictures.draw_errors({"qpsk": {"perfect": curve}}, "hall", tmp_path / "bler.png")
    above, below = figures[0].axes[:2]
    limits = [line for line in above.lines if line.get_marker() == "v" and len(line.get_xdata())]
    drawn = [line for line in above.lines if line.get_marker() == "."]
    assert np.isnan(drawn[0].get_ydata()).tolist() == [False, False, True]
    assert limits[0].get_xdata().tolist() == [4.0]
    assert limits[0].get_ydata().tolist() == [binomial_interval(0, 480)[1]]
    assert np.isnan(below.lines[0].get_ydata()[-1])
    assert "none failed: 95 % limit" in [text.get_text() for text in above.get_legend().get_texts()]
