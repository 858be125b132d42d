"""Outliers, frozen fixes, long gaps and lock-out; adaptive noise; filters by name."""

from dataclasses import replace

import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.filters.build import ENDINGS, KALMAN, build_filter, is_filter
from dlkf.filters.integration import integrate
from dlkf.filters.smoother import SmoothedSolution
from dlkf.filters.tuning import Tuning

from .scene import IMU, scene
from .test_constraints import slipping
from .test_stationarity import steady

D = torch.float64


def error(batch, name: str, imu=IMU, **tuning: float) -> torch.Tensor:
    solution = integrate(batch, build_filter(name, imu, tuning=Tuning(**tuning)))
    return (solution.posterior.p_n - batch.truth.p_n).norm(dim=-1)


def with_outliers(batch, share: float = 0.05, size: float = 100.0):
    g = torch.Generator().manual_seed(1)
    hit = torch.rand(batch.size[:2], generator=g) < share
    hit[:, :5] = False
    gnss = batch.gnss.clone()
    direction = torch.randn(*hit.shape, 3, generator=g, dtype=D)
    gnss[..., :3] += hit.unsqueeze(-1) * size * direction / direction.norm(dim=-1, keepdim=True)
    return replace(batch, gnss=gnss)


def test_outliers_are_refused_and_good_fixes_are_not():
    clean = scene(30, 120, seed=1)
    batch = with_outliers(clean)
    gated = integrate(batch, build_filter("mbkf15_gated", IMU))
    worst = (gated.posterior.p_n - batch.truth.p_n).norm(dim=-1)[:, 20:]
    assert worst.max() < 1.0 and error(batch, "mbkf15")[:, 20:].max() < 1.0  # which has the coarse gate
    without = integrate(clean, build_filter("mbkf15_gated", IMU)).used
    assert without[:, 10:].float().mean() > 0.995


def test_a_filter_sure_of_a_wrong_place_finds_back():
    """A start 200 m off with a 1σ of 1 m: the first fix is refused; the filter follows the second, which agrees."""
    batch = scene(10, 60, seed=2)
    lost = replace(batch, start=batch.start._replace(p_n=batch.start.p_n + 200.0))
    off = error(lost, "mbkf15_gated")
    assert off[:, 0].min() > 100.0 and off[:, 2].max() < 1.0 and off[:, 30:].max() < 1.0


def test_frozen_receiver_is_not_believed():
    batch = scene(10, 90, seed=3)
    gnss = batch.gnss.clone()
    gnss[:, 40:60] = gnss[:, 39:40]
    frozen = replace(batch, gnss=gnss)
    for name in ("mbkf15_gated", "mbkf15"):
        off = error(frozen, name)
        assert off[:, 40:60].max() < 30.0  # twenty seconds on inertial sensors alone
        assert off[:, 65:].max() < 1.0


def test_a_filter_with_a_wrong_velocity_is_not_locked_out():
    """5 m/s off with a 1σ of 0.1 m/s, so that attitude and biases change instead: over 100 m off without the gate."""
    batch = scene(10, 60, seed=6)
    lost = replace(batch, start=batch.start._replace(v_n=batch.start.v_n + 5.0, p_n=batch.start.p_n + 20.0))
    assert error(lost, "mbkf15_gated")[:, 40:].max() < 3.0 and error(lost, "mbkf15")[:, 40:].max() > 30.0


def test_a_receiver_that_froze_stays_frozen_while_the_car_stands():
    """Frozen on the move, then the car stops: the stale fix agrees with itself, and is still not believed."""
    batch = slipping(5, 80, (0.0, 0.0, 0.0, 0.0, 0.0), stop=50)
    gnss = batch.gnss.clone()
    gnss[:, 38:] = gnss[:, 37:38]
    off = error(replace(batch, gnss=gnss), "mbkf15_nhc_gated")
    stale = (batch.gnss[:, 37] - batch.gnss[:, 79])[:, :3].norm(dim=-1)
    assert stale.min() > 50.0 and off[:, 79].max() < 0.4 * stale.min()


@pytest.mark.parametrize("name", ["mbkf15", "mbkf21_car", "mbkf33_car_gated"])
def test_a_velocity_that_a_receiver_holds_at_zero_is_known_to_its_limit(name):
    """Cars that creep at 0.3 to 0.5 m/s under positions of centimetres: their velocity is that of the positions."""
    batch = steady((0.3, 0.4, 0.5), 60)
    gnss, std = batch.gnss.clone(), batch.gnss_std.clone()
    gnss[..., 3:], std[..., 3:] = 0.0, 0.05
    velocity = integrate(replace(batch, gnss=gnss, gnss_std=std), build_filter(name, IMU)).posterior.v_n
    assert (velocity - batch.truth.v_n)[:, 35:].norm(dim=-1).mean(1).max() < 0.09


def test_recovers_by_itself_after_a_long_gap():
    batch = scene(5, 300, seed=4)
    available = batch.available.clone()
    available[:, 60:260] = False
    off = error(replace(batch, available=available), "mbkf15_gated")
    assert off[:, 259].max() > 50.0 and off[:, 270:].max() < 1.0


def test_adaptive_noise_learns_what_the_receiver_does_not_say():
    """Fixes three times worse than their std says: R grows towards the truth, and stays where it was right."""
    said = scene(20, 200, seed=5, position_std=0.3, velocity_std=0.3)
    wrong = replace(said, gnss_std=said.gnss_std / 3)

    def adapted(batch):
        filter = build_filter("aekf", IMU, tuning=Tuning(forgetting=0.98))
        with torch.no_grad():
            R = integrate(batch, filter, keep_covariances=True).covariances.R
        return R[:, -30:].mean().sqrt()

    assert 0.2 < adapted(wrong) < 0.4 and 0.2 < adapted(said) < 0.4


def test_names():
    for base in KALMAN:
        for ending in ENDINGS:
            if ending != "prior":
                built = build_filter(f"{base}_{ending}", IMU)
                assert isinstance(built, SmoothedSolution) == (ending == "rts")
    assert is_filter("mbkf33_nhc_gated") and not is_filter("mbkf15_nhc_nhc") and not is_filter("mbkf16")
    with pytest.raises(InputError, match="_nhc"):
        build_filter("mbkf21_nch", IMU)
    with pytest.raises(InputError, match=r"gate is 1\.5, must be below 1"):
        build_filter("mbkf21", IMU, tuning=Tuning(gate=1.5))
    with pytest.raises(InputError, match=r"prior\.mean"):
        build_filter("mbkf21_prior_nhc", IMU)
