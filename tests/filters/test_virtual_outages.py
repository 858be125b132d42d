"""Virtual outages: the trajectory without corrections by the filter's own, and the noise that its errors show."""

import math
from dataclasses import replace

import torch

from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.plus import ANY_MEMS, PlusConfig, PlusFilter
from dlkf.filters.tuning import Tuning
from dlkf.filters.virtual_outages import LEVELS, SCORED_S, TRUST, VirtualOutage
from dlkf.navigation.error_model import source_scale
from dlkf.navigation.imu_errors import imu_spec
from dlkf.navigation.state import PVA

from .scene import RATE, scene

GYRO, ACCEL = 4 * 6.98132e-5, 25 * 9.80665e-4  # level 1: of ANY_MEMS by any_car


class Watched:
    """A Kalman filter with a virtual outage beside it, both kept update by update."""

    def __init__(self, kalman, gyro_factor=1.0):
        self.kalman, self.gyro_factor, self.outages = kalman, gyro_factor, []

    def begin(self, batch):
        memory, error = self.kalman.begin(batch)
        return (memory, VirtualOutage.begin(memory.P)), error

    def step(self, memory, epoch):
        kalman, outage = memory
        kalman, correction = self.kalman.step(kalman, epoch)
        factors = epoch.z.new_ones(len(epoch.z), 4, 3)
        factors[:, 1] = self.gyro_factor
        scale = source_scale(factors, epoch.start.C_nb)
        outage = outage.update(epoch, correction.covariances, kalman.windows, scale)
        self.outages.append(outage)
        return (kalman, outage), correction


def kalman(name="mbkf21"):
    return build_filter(name, imu_spec(ANY_MEMS), tuning=Tuning(accel_noise=25.0, gyro_noise=4.0))


def test_it_is_the_run_without_fixes_to_first_order():
    """Estimate and covariance after 9 s: with fixes less drift, against a run that never got one, where biases of 0.02
    m/s² and 1e-3 rad/s keep corrections so small that their squares are a hundredth."""
    bias = torch.tensor([[0.02, -0.01, 0.02, 1e-3, -5e-4, 1e-3]], dtype=torch.float64) * torch.tensor([[1.0], [-1.0]])
    batch = scene(2, 9, seed=4, lever_arm=(0.4, 0.1, -0.7), noise=False, bias=bias.double())
    watched = Watched(kalman())
    with torch.no_grad():
        solution = integrate(batch, watched)
        alone = integrate(replace(batch, available=~batch.available), kalman(), keep_covariances=True)
    last = watched.outages[-1]
    moved = solution.posterior.p_n[:, -1] - alone.posterior.p_n[:, -1]
    assert moved.norm(dim=-1).min() > 0.3  # there is something to see
    assert (last.drift[:, :3] - moved).norm(dim=-1).max() < 0.02 * moved.norm(dim=-1).min()
    P = last.P[:, PVA, PVA] + last.white[:, :2].sum(1)
    expected = alone.covariances.updated[:, -1, PVA, PVA]
    size = expected.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((P - expected) / (size[:, None] * size[:, :, None])).abs().max() < 0.02
    silent = build_filter("mbkf21", imu_spec(ANY_MEMS), tuning=Tuning(accel_noise=1e-6, gyro_noise=1e-6))
    with torch.no_grad():
        others = integrate(replace(batch, available=~batch.available), silent, keep_covariances=True)
    assert others.covariances is not None
    white = (expected - others.covariances.updated[:, -1, PVA, PVA]).diagonal(dim1=-2, dim2=-1)
    assert torch.allclose(last.white[:, :2].sum(1).diagonal(dim1=-2, dim2=-1), white, rtol=0.03)


def levels_found(accel, gyro, seconds=160):
    """Of drives whose white noise has these levels (B,), after so long."""
    batch = scene(len(accel), seconds, seed=6, noise=False)
    g, D = torch.Generator().manual_seed(2), torch.float64
    density = torch.stack((ACCEL * accel, GYRO * gyro), -1).repeat_interleave(3, -1)
    noise = torch.randn(batch.imu.shape, generator=g, dtype=D) * math.sqrt(RATE) * density[:, None, None]
    fixes = batch.gnss + batch.gnss_std * torch.randn(batch.gnss.shape, generator=g, dtype=D)
    watched = Watched(kalman())
    with torch.inference_mode():
        integrate(replace(batch, imu=batch.imu + noise, gnss=fixes), watched)
    return watched.outages[-1].estimates()[0]


def test_the_level_found_rises_and_falls_with_the_true_one():
    """From an eighth of the noise taken for granted to eight times as much, means of three drives of 160 s; the filter
    beside it keeps its noise. The slope of ln(found) over ln(true) is between 0.4 and 1.1: a prior of 1σ = 1 holds
    back, and what this filter does not know when an outage begins hides the difference of an eighth and a half. Of one
    sensor alone the slope of the other is less than half of its own: heights tell them apart."""
    true = torch.tensor([1 / 8, 1 / 2, 2.0, 8.0], dtype=torch.float64)
    x, every, one = true.log(), true.repeat_interleave(3), torch.ones(12, dtype=torch.float64)
    found = levels_found(torch.cat((every, one, every)), torch.cat((one, every, every))).log()
    found = found.unflatten(0, (3, 4, 3)).mean(2)  # which differ, true level, sensor
    slopes = (x[:, None] * found).sum(1) / x.square().sum()
    own = torch.cat((slopes.diagonal(), slopes[2]))
    assert ((own > 0.4) & (own < 1.1)).all(), slopes
    assert slopes[0, 1] < 0.5 * slopes[0, 0] and slopes[1, 0] < 0.5 * slopes[1, 1], slopes
    assert (found[2, :2] < math.log(0.6)).all() and (found[2, 1:].diff(dim=0) > 0.2).all(), found


def test_nothing_is_learned_before_an_outage_was_scored_nor_without_fixes():
    batch = scene(2, 50, seed=1)
    t = torch.arange(50)
    batch = replace(batch, available=((t < 25) | (t >= 45)).expand(2, -1))
    watched = Watched(kalman())
    with torch.inference_mode():
        integrate(batch, watched)
    levels = torch.stack([x.estimates()[0] for x in watched.outages], 1)
    assert (levels[:, : int(SCORED_S) - 1] == 1).all()
    assert (levels[:, 24] != 1).all()
    assert torch.equal(levels[:, 24:45], levels[:, 24:25].expand(-1, 21, -1))


def test_one_wild_fix_does_not_decide():
    """40 m off where an outage is scored: the levels move by less than a factor of 1.6."""
    batch = scene(4, 32, seed=3)
    wild = batch.gnss.clone()
    wild[:, 19, 0] += 40.0
    found = []
    for gnss in (batch.gnss, wild):
        watched = Watched(kalman())
        with torch.inference_mode():
            integrate(replace(batch, gnss=gnss), watched)
        found.append(watched.outages[20].estimates()[0])
    assert (found[1] / found[0]).log().abs().max() < math.log(1.6)


def test_plus_takes_over_the_levels(claimed):
    """Of a drive with an eighth of the noise: after minutes of fixes an outage's 1σ grows more slowly than that of the
    constants, and in its network's absence not before the first virtual outage was scored."""
    model = PlusFilter(PlusConfig.from_mapping({"base": "mbkf21", "network": {"hidden": 16}})).eval()
    for p in model.parameters():
        torch.nn.init.zeros_(p)
    batch = scene(2, 110, seed=8, noise=False)
    batch = replace(batch, available=(torch.arange(110) < 95).expand(2, -1))
    with torch.inference_mode():
        a, b = integrate(batch, model), integrate(batch, build_filter("mbkf21", model.imu, tuning=model.tuning))
    assert torch.equal(a.std[:, : int(SCORED_S)], b.std[:, : int(SCORED_S)])
    assert (a.std[:, -1, :2] < 0.85 * b.std[:, -1, :2]).all()
    assert LEVELS[0] < 1 / 8


def test_a_networks_factors_count_as_far_as_outages_bear_them_out():
    """A network that scales the gyroscopes' noise by 8, on drives where it is eight times that of the filter and on
    drives where it is an eighth: after 160 s its probability, 0.9 at the start, is above 0.95 and below 0.5."""
    batch = scene(6, 160, seed=6, noise=False)
    g, D = torch.Generator().manual_seed(2), torch.float64
    gyro = torch.tensor([8.0] * 3 + [1 / 8] * 3, dtype=D)
    density = torch.stack((ACCEL * torch.ones(6, dtype=D), GYRO * gyro), -1).repeat_interleave(3, -1)
    noise = torch.randn(batch.imu.shape, generator=g, dtype=D) * math.sqrt(RATE) * density[:, None, None]
    fixes = batch.gnss + batch.gnss_std * torch.randn(batch.gnss.shape, generator=g, dtype=D)
    watched = Watched(kalman(), gyro_factor=8.0)
    with torch.inference_mode():
        integrate(replace(batch, imu=batch.imu + noise, gnss=fixes), watched)
    weight = torch.stack([x.estimates()[1] for x in watched.outages], 1)
    assert torch.allclose(weight[:, 0], weight.new_tensor(TRUST))
    assert (weight[:3, -1] > 0.95).all() and (weight[3:, -1] < 0.5).all(), weight[:, -1]
