"""IMU samples one at a time against the loader, which has them all."""

from __future__ import annotations

import numpy as np
import pytest

from dlkf.base.errors import InputError
from dlkf.data.resampling import epoch_grid, resample_imu
from dlkf.running.imu_stream import COLUMNS, ImuStream


def _log(rate: float, t0: float, seconds: float = 20.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Stamps that jitter by a third of an interval, one in thirty missing; values that wander."""
    g = np.random.default_rng(seed)
    n = round(seconds * rate)
    t = t0 + (np.arange(1, n + 1) + g.uniform(-0.3, 0.3, n)) / rate
    x = 0.01 * np.cumsum(g.normal(size=(n, 6)), 0)
    kept = g.random(n) > 1 / 30
    return t[kept], x[kept]


def _fed(stream: ImuStream, t: np.ndarray, x: np.ndarray, phase: float) -> np.ndarray:
    done = []
    for stamp, row in zip(t.tolist(), x.tolist()):
        assert stream.find_refusal(stamp, row[:3], row[3:]) == ""
        if stream.grid is None and stamp > t[0] + 3:
            stream.begin(np.array([phase]))
        done += stream.close_epochs()
    return np.concatenate([x.imu for x in done + stream.close_epochs(ended=True)])


@pytest.mark.parametrize("t0", [0.0, 1.7e9])
@pytest.mark.parametrize("rate", [50.0, 104.3, 400.0])
def test_epochs_are_those_of_the_loader(rate, t0):
    """The integral is summed from another beginning: rounding of values of 1."""
    t, x = _log(rate, t0)
    grid = epoch_grid(t, np.array([t0 + 0.3, t0 + 5.3]), 50, 1.0, "log")
    whole = resample_imu(dict(zip(COLUMNS, np.column_stack((t, x)).T)), grid)
    stream = ImuStream(50, 1.0, step_s=float(np.median(np.diff(t))))
    assert np.abs(_fed(stream, t, x, grid.t0) - whole).max() < 1e-11
    assert len(stream._rows) < 1.2 * rate + 5


def test_the_open_epoch_reaches_to_the_latest_sample():
    """Its integral is that of the samples since the boundary."""
    stream = ImuStream(50, 1.0)
    t = np.arange(1, 437) / 100
    x = np.ones((len(t), 6)) * t[:, None]
    _fed(stream, t, x, 0.0)
    samples, dt = stream.open()
    assert samples.shape == (1, 50, 6) and dt == pytest.approx(0.36 / 50)
    assert (samples.sum(1) * dt)[0] == pytest.approx(x[400:].sum(0) / 100, rel=1e-4)  # sculling of such a ramp


def test_what_is_out_of_line_is_refused_and_believed_when_it_goes_on():
    def stream() -> ImuStream:
        s = ImuStream(50, 1.0)
        _fed(s, np.arange(1, 501) / 100, np.zeros((500, 6)), 0.0)
        return s

    s = stream()
    still = (0.0, 0.0, -9.8), (0.0, 0.0, 0.0)
    assert "duplicate" in s.find_refusal(5.0, *still) and "goes back" in s.find_refusal(3.0, *still)
    assert "gap of 4.000 s" in s.find_refusal(9.0, *still) and not s.lost
    assert s.find_refusal(5.01, *still) == "" and not s.lost  # the line goes on
    for t in 2.0 + np.arange(90) / 100:
        assert s.find_refusal(t, *still)
    assert not s.lost and s.find_refusal(5.02, *still) == ""
    for t in 9.0 + np.arange(102) / 100:
        assert s.find_refusal(t, *still)
    assert s.lost
    s.clear()
    assert not s.lost and s.grid is None and s.find_refusal(10.1, *still) == ""


@pytest.mark.parametrize(
    "accel,gyro,words",
    [
        ((0.0, np.nan, 0.0), (0.0,) * 3, "finite"),
        ((0.0,) * 3, (np.inf, 0.0, 0.0), "finite"),
        ((401.0, 0.0, 0.0), (0.0,) * 3, "beyond"),
        ((0.0,) * 3, (0.0, -41.0, 0.0), "beyond"),
        ((0.0, 0.0), (0.0,) * 3, "3 and 3"),
    ],
)
def test_damaged_samples(accel, gyro, words):
    assert words in ImuStream(50, 1.0).find_refusal(0.0, accel, gyro)


def test_an_epoch_must_hold_whole_samples():
    with pytest.raises(InputError, match="whole number"):
        ImuStream(50.5, 1.0)


def test_before_the_first_fix_so_many_seconds_are_kept_and_no_more():
    """A receiver may be silent for hours."""
    stream = ImuStream(50, 1.0, keep_s=2.0)
    for k in range(1, 1001):
        assert stream.find_refusal(k / 100, (0.0, 0.0, -9.8), (0.0, 0.0, 0.0)) == ""
    assert stream._rows[-1][0] - stream._rows[0][0] == pytest.approx(2.0, abs=0.011)


def test_a_sample_that_stays_the_same_is_refused_on_a_moving_car_alone():
    """For longer than half a second; a stamp far ahead does not count."""
    still = (0.0, 0.0, -9.8), (0.0, 0.0, 0.0)
    for moves, refused in ((True, 50), (False, 0)):
        s = ImuStream(50, 1.0, moves=lambda moves=moves: moves)
        said = [s.find_refusal(t, *still) for t in (np.arange(1, 102) / 100).tolist()]
        assert [bool(x) for x in said] == [False] * (101 - refused) + [True] * refused
        assert all("frozen" in x for x in said if x)
        assert s.find_refusal(1.02, (0.0, 0.0, -9.7), (0.0, 0.0, 0.0)) == (
            "" if not moves else "gap of 0.510 s after t = 0.510000"
        )
        assert "gap" in s.find_refusal(9.0, *still)
