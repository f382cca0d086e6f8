"""Paths, boxes and patches against the exact simulator and brute force;
then learned in small rooms.
"""

import math
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from gains import phased
from rooms import PILLAR, WAVELENGTH

from gsparc.models.image_sources.clutter import finite_mirrors
from gsparc.models.image_sources.clutter.blocking import Clutter, plane_tangents
from gsparc.models.image_sources.clutter.boxes import find_occluding_box
from gsparc.models.image_sources.clutter.finite_mirrors import find_small_mirrors
from gsparc.models.image_sources.clutter.residual import ClutterLikelihood, UnexplainedRows
from gsparc.models.image_sources.gp_likelihood import GainPosterior
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import KernelVisibility, SourceScene
from gsparc.physics.mirror_planes import all_sequences
from gsparc.processes.worker import Cancelled, cancel_when

SIZE = torch.tensor([4.0, 3.0, 2.5], dtype=torch.float64)
TRANSMITTER = SIZE * torch.tensor([0.15, 0.27, 0.75], dtype=torch.float64)
WALLS = torch.tensor(
    [[1.0, 0, 0, 0], [1, 0, 0, 4], [0, 1, 0, 0], [0, 1, 0, 3], [0, 0, 1, 0], [0, 0, 1, 2.5]],
    dtype=torch.float64,
)
TABLE = torch.tensor([0.0, 0, 1, 0.75], dtype=torch.float64)


def _sequences(order: int) -> tuple:
    """Every image of the shoebox once: of both orders of perpendicular walls the sorted one."""
    sequences = all_sequences(list(range(6)), order)
    kept = [w for w in sequences if len(w) < 2 or w[0] // 2 == w[1] // 2 or w[0] < w[1]]
    return ((), *kept)


def _scene(clutter: Clutter, order: int = 1) -> SourceScene:
    sequences, law = _sequences(order), KernelVisibility(0.95, 0.6, 1.5)
    return SourceScene(
        TRANSMITTER, WALLS, sequences, torch.zeros(len(sequences)), -4.0, law, clutter
    )


def _rows(count: int, seed: int = 0) -> Rows:
    position = torch.from_numpy(np.random.default_rng(seed).uniform(0.1, 0.9, (count, 3))) * SIZE
    frequency = torch.full((count,), 2.4e9, dtype=torch.float64)
    return Rows(
        position, frequency, torch.zeros(count, 1, dtype=torch.complex64), torch.arange(count)
    )


def _room() -> torch.Tensor:
    return torch.stack([torch.zeros(3), SIZE.float()])


def _box() -> torch.Tensor:
    return torch.from_numpy(PILLAR.reshape(1, 6)).float()


def _boxed(box: torch.Tensor) -> Clutter:
    return Clutter(box, torch.zeros(0, 4), ())


def _table() -> tuple[torch.Tensor, Clutter]:
    """Planes with a table top, and its patch: 1.2 to 2.6 m, 0.8 to 2.2 m."""
    corners = torch.tensor([[1.2, 0.8, 0.75], [2.6, 2.2, 0.75]]) @ plane_tangents(TABLE).T
    patch = torch.cat([corners.amin(0), corners.amax(0)])
    return torch.cat([WALLS, TABLE[None]]), Clutter(torch.zeros(0, 6), patch[None], (6,))


def test_a_patch_reflects_inside_only_and_hides_what_is_behind():
    planes, clutter = _table()
    scene = SourceScene(TRANSMITTER, planes, ((), (6,)), torch.zeros(2), 0.0, clutter=clutter)
    above_middle = [2.5, 1.9, 1.0]
    above_beside = [3.9, 2.9, 0.8]  # the reflection would lie beyond the edge
    under = [2.4, 1.8, 0.2]
    seen = scene.visible_share(
        torch.tensor([above_middle, above_beside, under], dtype=torch.float64)
    )
    assert (seen[:, 1] > 0.5).tolist() == [True, False, False]
    assert (seen[:, 0] > 0.5).tolist() == [True, True, False]


def test_score_is_what_the_best_multiple_gains():
    rows = replace(_rows(20), target=torch.randn(20, 1, dtype=torch.complex64))
    left = _unexplained(rows, _bare())
    scene, scorer = left.scene, left.scorer
    change = torch.randn(20, 8, dtype=torch.complex64)
    score, multiple = scorer.gains_and_multiples(change)
    best = int(score.argmax())
    moved = replace(rows, target=rows.target - (multiple[best] * change[:, best])[:, None])
    gain = GainPosterior(rows, scene).nll - GainPosterior(moved, scene).nll
    assert score[best].item() == pytest.approx(gain, rel=0.02)


def _truth(scene: SourceScene, rows: Rows, noise: float = 0.02) -> Rows:
    """What such a scene would be measured as, in unit power."""
    torch.manual_seed(0)
    target = scene.waves(rows).sum(1, keepdim=True)
    target = target + noise * torch.randn(target.shape, dtype=torch.complex64)
    return replace(rows, target=target / target.abs().square().mean().sqrt())


def test_the_pillar_is_found_by_its_shadow():
    rows = _truth(_scene(_boxed(_box())), _rows(150))
    box, score = find_occluding_box(_unexplained(rows, _bare()), draws=500)
    assert score > 20
    middle = (box[:2] + box[3:5]) / 2
    torch.testing.assert_close(middle, torch.tensor([1.8, 1.4]), atol=0.25, rtol=0)


def _bare(sources: int = 7) -> SourceScene:
    """A shoebox of known phases without clutter."""
    return phased(_scene(Clutter.empty()), torch.zeros(sources))


def _unexplained(rows: Rows, start: SourceScene) -> UnexplainedRows:
    """What is left of rows by a scene without clutter, with its noise."""
    residual = ClutterLikelihood(rows, start)
    scene, paths = residual.scene, start.unfolding.paths(rows.position)
    scorer = residual.make_scorer(torch.ones(len(start.sequences), len(rows)), scene.log_amplitude)
    waves, generator = start.unobstructed_waves(rows), torch.Generator().manual_seed(0)
    return UnexplainedRows(rows, scene, scorer, paths, waves, _room(), generator)


def _beside_a_table(count: int) -> tuple[UnexplainedRows, Clutter]:
    """What walls leave unexplained of rows in a room with a table, and the table."""
    planes, clutter = _table()
    sequences = (*_sequences(1), (6,), (6, 5), (2, 6))
    true = SourceScene(
        TRANSMITTER, planes, sequences, torch.zeros(len(sequences)), -4.0, clutter=clutter
    )
    rows = _truth(true, _rows(count))
    return _unexplained(rows, _bare()), clutter


def test_a_table_top_is_found_by_its_reflections():
    left, clutter = _beside_a_table(200)
    best = find_small_mirrors(left, 3)[0]
    assert best.plane[2].abs() == 1 and best.score > 15
    assert (best.plane[3] * best.plane[2] - 0.75).abs() < WAVELENGTH
    found, true = (patch.view(2, 2).mean(0) for patch in (best.patch, clutter.patches[0]))
    torch.testing.assert_close(found, true, atol=0.4, rtol=0)


@pytest.mark.slow
def test_a_wide_site_is_not_searched_for_mirrors(monkeypatch, caplog):
    """A raster of 35 cm cells over 40 km asked for six terabytes."""
    left, _ = _beside_a_table(60)
    whole = find_small_mirrors(left, 3)
    monkeypatch.setattr(finite_mirrors, "BLOCK_CELLS", 2e4)  # the raster in parts is the same
    parts = find_small_mirrors(left, 3)
    assert len(whole) > 0 and [m.score for m in parts] == [m.score for m in whole]
    with caplog.at_level("INFO"):
        assert find_small_mirrors(replace(left, room=1e4 * _room()), 3) == []
    assert "no search for small mirrors" in caplog.text


def test_a_search_for_mirrors_in_a_wide_room_ends_when_it_is_told():
    """It looked at neither clock nor interrupt: it was at 150 s and going."""
    left, _ = _beside_a_table(60)
    spent: list[float] = []

    def unwanted() -> bool:
        spent.append(time.thread_time())
        return spent[-1] > spent[0] + 0.5

    with cancel_when(unwanted), pytest.raises(Cancelled):
        find_small_mirrors(replace(left, room=4 * _room()), 3)
    assert max(np.diff([*spent, time.thread_time()])) < 0.5
    room, cells = 20 * _room(), []

    def nothing(*args) -> tuple:
        cells.append((len(args[1]), args[3]))
        return torch.zeros(len(args[1])), torch.zeros(len(args[1]), 4)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finite_mirrors, "_best_rectangles", nothing)
        patch.setattr(finite_mirrors, "MAX_CELLS", 1e12)
        find_small_mirrors(replace(left, room=room, scene=left.scene.select_sources([0, 1])), 3)
    count = sum(planes for planes, _ in cells) * math.prod(
        finite_mirrors._count_cells(room, plane_tangents(WALLS[0]), cells[0][1])
    )
    assert 3 * count < 1.1 * finite_mirrors.MOST_CELLS, "a plane and one wall: three sequences"
