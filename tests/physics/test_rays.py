import numpy as np

from gsparc.physics.rays import closest_ranges_and_gap


def test_rays_towards_one_point_meet_there_and_others_never():
    ends, point, aside = (
        np.array([[0.0, 0, 1], [4.0, 0, 1]]),
        np.array([1.0, 3, 2]),
        np.array([0.0, 0, 1]),
    )
    far = np.linalg.norm(point - ends, axis=1)
    one, other = (point - ends) / far[:, None]
    rays = np.array([one, aside]), np.array([other, -other, aside])
    s, t, gap = closest_ranges_and_gap(ends[0], rays[0], ends[1], rays[1])
    assert np.allclose([s[0, 0], t[0, 0]], far)
    assert abs(gap[0, 0]) < 1e-9 and np.isinf(gap[0, 1])  # behind the second place
    assert np.isinf(gap[1, 2]) and gap[0, 2] > 1  # parallel; askew
