"""A car that stands in an outage, whose wheel says so and whose samples do not: it shakes, and GNSS had no velocity."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dlkf.data.aid_tables import STANDARD
from dlkf.filters.aids.attach import with_aids
from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from dlkf.navigation.state import NavState
from tests.cars import IMU, car_batch

LOST, END = 15, 60  # s: the outage
SHAKE = (0.1, 0.02)  # m/s², rad/s: of a car in the wind, above what is taken for standing until the drive shows it


@pytest.fixture(scope="module")
def standing():
    """Three cars that stand, with fixes without velocity, then none; and what their wheels say, once a second."""
    batch = car_batch(3, END)
    B, T, M = batch.size
    C, p = batch.truth.C_nb[:, 0], batch.truth.p_n[:, 0]
    rest = torch.cat(
        ((C.mT @ -batch.frame.gravity(p)[..., None])[..., 0], (C.mT @ batch.frame.earth_rate_n[..., None])[..., 0]), -1
    )
    sign = 1.0 - 2.0 * ((10 * torch.arange(M) // M) % 2)  # at 5 Hz; sums to zero
    shake = torch.tensor([SHAKE[0]] * 3 + [SHAKE[1]] * 3) * sign[:, None]
    imu = rest[:, None, None] + batch.true_imu_error[:, :, None] + shake
    truth = NavState(p[:, None].repeat(1, T, 1), torch.zeros(B, T, 3).double(), C[:, None].repeat(1, T, 1, 1))
    start = NavState(p, torch.zeros(B, 3).double(), C)
    gnss = batch.gnss - torch.cat((batch.truth.p_n, batch.truth.v_n), -1) + torch.cat((truth.p_n, truth.v_n), -1)
    zero = torch.zeros(B, T).double()
    return replace(
        batch, imu=imu, start=start, truth=truth, gnss=gnss,
        gnss_valid=torch.tensor([True] * 3 + [False] * 3).expand(B, T, 6),
        available=(torch.arange(T) < LOST).expand(B, T),
        aids={"speed": torch.stack((zero, zero, zero, zero, zero + 1), -1)},
    )  # fmt: skip


@pytest.mark.whole
@pytest.mark.parametrize("name", ["mbkf21_car", "mbkf33_car"])
def test_a_car_whose_wheel_stands_does_not_slide_sideways(standing, name):
    model = with_aids(build_filter(name, IMU), [STANDARD["speed"]])
    with torch.no_grad():
        solution = integrate(standing, model)
    error = (solution.posterior.p_n - standing.truth.p_n)[:, -1, :2].norm(dim=-1)
    assert error.max() < 0.5, error
