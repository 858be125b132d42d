"""What stands beside published figures: KITTI's error of relative poses, in closed form."""

import math

import numpy as np
from pipelines.studies.kitti_odometry import LENGTHS_M, left_out_best, segment_errors


def turned(yaw: np.ndarray) -> np.ndarray:
    """Rotations about z."""
    c, s, o, i = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
    return np.stack((np.stack((c, -s, o), -1), np.stack((s, c, o), -1), np.stack((o, o, i), -1)), -2)


def test_a_wrong_scale_is_the_same_share_of_every_length():
    """A straight way of 1 km, 9 m a step, measured 2 % too long."""
    true_p = np.zeros((112, 3))
    true_p[:, 0] = 9.0 * np.arange(112)
    C = turned(np.full(112, 0.3))
    e = segment_errors(1.02 * true_p, C, true_p, C)
    assert np.allclose(e.translation, 0.02) and np.allclose(e.rotation, 0)
    # of 999 m the first pose from which more than L is left, 9 m apart
    assert [int((e.length_m == L).sum()) for L in LENGTHS_M] == [111 - math.floor(L / 9) for L in LENGTHS_M]


def test_a_constant_turn_rate_bends_the_way_by_its_chord():
    """The estimate turns by κ per metre where the truth goes straight: after s m it is a circle's point, seen from its
    own first pose (sin κs, 1 − cos κs) / κ, and κs is the angle."""
    kappa, s = 1e-4, 5.0 * np.arange(201)
    true_p = np.stack((s, 0 * s, 0 * s), -1)
    p = np.stack((np.sin(kappa * s), 1 - np.cos(kappa * s), 0 * s), -1) / kappa
    e = segment_errors(p, turned(kappa * s), true_p, turned(0 * s))
    ends = np.array([L + 5.0 for L in e.length_m])  # more than L: the next pose
    expected = np.hypot(ends - np.sin(kappa * ends) / kappa, (1 - np.cos(kappa * ends)) / kappa) / ends
    assert np.allclose(e.translation, expected, atol=1e-9)
    assert np.allclose(e.rotation, kappa, rtol=1e-4)  # of the arc cosine near 1


def test_errors_are_relative_to_the_first_pose():
    """Another origin and heading of the whole estimate is no error."""
    rng = np.random.default_rng(0)
    true_p = np.cumsum(rng.normal(size=(300, 3)) + [4, 0, 0], 0)
    true_C = turned(rng.normal(size=300))
    R = turned(np.array([1.1]))[0]
    e = segment_errors(true_p @ R.T + 50, R @ true_C, true_p, true_C)
    assert len(e.translation) > 1000 and e.translation.max() < 1e-9 and e.rotation.max() < 1e-6


def test_constants_come_from_the_other_sequences():
    """Candidate 0 is best on a, candidate 1 on b and c: a's own error has no say."""
    straight = np.zeros((60, 3))
    straight[:, 0] = 5.0 * np.arange(60)
    C = turned(np.zeros(60))

    def scaled(by: float):
        return segment_errors((1 + by) * straight, C, straight, C)

    errors = [[scaled(0.0), scaled(0.04), scaled(0.04)], [scaled(0.5), scaled(0.01), scaled(0.01)]]
    assert left_out_best(errors, ["a", "b", "c"]) == {"a": 1, "b": 0, "c": 0}
