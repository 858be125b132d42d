"""The gates' verdicts on one fix by hand, and filters with outliers, steps and outages."""

import math
from dataclasses import replace

import pytest
import torch

from dlkf.filters.build import build_filter
from dlkf.filters.coasting import Coasting
from dlkf.filters.gating import (
    AGREEMENT_RATES,
    COARSE_FLOOR,
    COARSE_PATIENCE,
    COARSE_SIGMAS,
    FLOOR,
    HOLD_S,
    PATIENCE,
    USUAL_STEP,
    CoarseGate,
    Gate,
    _predicted_variance,
)
from dlkf.filters.integration import Fix, integrate
from dlkf.filters.shipped import trained_filter
from dlkf.navigation.calibration import ImuError

from .scene import IMU, beside, scene
from .test_constraints import epoch_of, slipping


def judged(off: float, before: float = 0.0, refused: int = 0, usual: float = 0.0, *, std: float = 1.0, height=0.0):
    """A position ``off`` [m] along north of a filter without any error, a second after one ``before`` [m] off that was
    the last of ``refused``; fixes of 1σ ``std`` for a filter that takes them so. The memory after, the epoch, P."""
    batch = scene(1, 1)
    epoch = epoch_of(batch, batch.start, ImuError(batch.imu.new_zeros(1, 6)))
    z, used = torch.zeros_like(epoch.z), torch.tensor([[True] * 3 + [False] * 3])
    z[0, 0], z[0, 2] = off, height
    gate, fix = Gate(0.999, usual), Fix(z, torch.full_like(z, std), used, None)
    memory = gate.begin(epoch.z)
    memory.innovation[0, 0], memory.refused[0, 0] = before, refused
    return gate.screen_fix(memory, epoch._replace(z=z, fix=fix), torch.zeros(1, 15, 15).to(z), fix.std.square())


def test_the_limit_by_hand():
    """χ² of two degrees of freedom at 0.999 is −2 ln 0.001: as a mean over north and east, off by √(2 · 6.9) 1σ."""
    limit = (-2 * math.log(0.001) * (1 + FLOOR**2)) ** 0.5
    for off, kept in ((0.999 * limit, True), (1.001 * limit, False)):
        memory, epoch, P = judged(off)
        assert epoch.used[0].tolist() == [kept] * 3 + [False] * 3 and not P.any()
        assert float(epoch.z[0, 0]) == off * kept and float(memory.refused[0, 0]) == 1.0 - kept
    assert judged(0.0, height=3.28 * (1 + FLOOR**2) ** 0.5)[1].used[0].tolist() == [True] * 3 + [False] * 3
    assert judged(0.0, height=3.30 * (1 + FLOOR**2) ** 0.5)[1].used[0].tolist() == [True, True, *[False] * 4]


def test_an_outlier_is_larger_than_usual():
    """Where d² is usually 9 times its median, the limit is 3 times as far; and s² follows by a step, never below 1."""
    usual, limit = 2 * math.log(3.0), 3 * (-2 * math.log(0.001) * (1 + FLOOR**2)) ** 0.5
    assert judged(0.999 * limit, usual=usual)[1].used[0, 0] and not judged(1.001 * limit, usual=usual)[1].used[0, 0]
    moved = judged(50.0, usual=1.0)[0].usual[0].tolist()
    assert moved == pytest.approx([1 + USUAL_STEP, 1 - USUAL_STEP, 1.0, 1.0])
    assert judged(0.0)[0].usual[0].tolist() == [0.0] * 4


def test_a_refused_position_agrees_with_one_as_far_off():
    """Within 6σ of both fixes, √6 cm (three axes each), and what 5 m/s make of the second between them."""
    limit = 6 * 0.01 * 6**0.5 + AGREEMENT_RATES[0]
    assert judged(50.0, 50.0 - limit + 0.01, 1, std=0.01)[1].used[0, 0]
    memory, epoch, P = judged(50.0, 50.0 - limit - 0.01, 1, std=0.01)
    assert not epoch.used[0, :2].any() and float(memory.refused[0, 0]) == 1 and not P.any()


def test_p_is_opened_by_what_contradicts_it():
    """At the last of the agreeing refusals: z² is added to the variance of the position, and the next starts anew."""
    for refused in range(PATIENCE):
        memory, epoch, P = judged(12.0, 12.0, refused)
        last = refused == PATIENCE - 1
        assert bool(epoch.used[0, 0]) is last and float(memory.refused[0, 0]) == (0 if last else refused + 1)
        assert P[0].diagonal().tolist() == [144.0 * last, *[0.0] * 14]


def test_the_variance_an_epoch_later():
    """A tilt of 10 mrad makes g · 0.01 m/s in a second and half of it in m; P of a car in motion carried on by Φ and Q,
    to what correlations make of it."""
    still = scene(1, 1)
    epoch = epoch_of(still, still.start, ImuError(still.imu.new_zeros(1, 6)))
    P = torch.zeros(1, 15, 15, dtype=torch.float64)
    P[0, 6, 6] = 1e-4
    assert _predicted_variance(epoch, P)[0].sqrt().tolist() == pytest.approx([0.04903] * 3 + [0.09807] * 3, rel=1e-3)
    batch = slipping(3, 30, (0.0,) * 5)
    estimator, seen = build_filter("mbkf15", IMU), []

    class Watched(type(estimator)):
        def update(self, memory, epoch):
            memory, correction = super().update(memory, epoch)
            seen.append((before.pop(), correction.covariances.predicted.diagonal(dim1=-2, dim2=-1)[:, :6]))
            return memory, correction

        def screen_fix(self, memory, epoch):
            before.append(_predicted_variance(epoch, memory.P))
            return super().screen_fix(memory, epoch)

    before: list[torch.Tensor] = []
    with torch.inference_mode():
        integrate(batch, Watched(**{name: getattr(estimator, name) for name in estimator.__dataclass_fields__}))
    ratio = torch.stack([(mine / its).sqrt() for mine, its in seen[5:]])
    assert ratio.min() > 0.5 and ratio.max() < 5.0 and 0.9 < ratio.median() < 1.6


def cars(name: str, epochs: int):
    """Cars that move as the filter's constraints say, where it has some."""
    return scene(3, epochs, seed=7) if name in ("mbkf15", "aekf") else slipping(3, epochs, (0.0,) * 5)


def shifted(batch, epochs: slice, components: slice, by: float):
    """Fixes off by so much in each of these components."""
    gnss = batch.gnss.clone()
    gnss[:, epochs, components] += by
    return replace(batch, gnss=gnss)


def hidden(batch, epochs: slice | torch.Tensor):
    available = batch.available.clone()
    available[:, epochs] = False
    return replace(batch, available=available)


def off(batch, solution, epoch: int) -> float:
    """Largest horizontal error [m]."""
    return float((solution.posterior.p_n - batch.truth.p_n)[:, epoch, :2].norm(dim=-1).max())


def solved(batch, name: str):
    estimator = trained_filter("plus") if name == "plus" else build_filter(name, IMU)
    with torch.inference_mode():
        return integrate(batch, estimator)


@pytest.mark.parametrize("name", ["mbkf15", "mbkf21_car", "aekf", "plus"])
def test_the_first_fix_after_an_outage_may_be_wrong(name):
    """2 km off after 20 s without GNSS, where a limit on speed must let it pass: the solution without it."""
    batch = hidden(cars(name, 60), slice(30, 50))
    wrong = shifted(batch, slice(50, 51), slice(0, 2), 2000.0)
    both = solved(beside(wrong, hidden(batch, slice(50, 51))), name)
    assert not both.used[:3, 50].any() and both.used[:3, 51:].all()
    found, without = both.posterior.p_n.split(3)
    with_it, without_it = ((p - batch.truth.p_n)[:, 50, :2].norm(dim=-1).max() for p in (found, without))
    assert with_it < without_it + 1e-6
    apart = (found - without)[:, 51:].abs().max()
    assert apart < (0.05 if name == "plus" else 1e-9)  # what plus knows of the receiver's errors has a 1σ more


@pytest.mark.parametrize("name", ["mbkf15", "plus"])
def test_a_velocity_that_cannot_be_is_left_out_alone(name):
    batch = cars(name, 40)
    found = solved(shifted(batch, slice(30, 31), slice(3, 4), 40.0), name)
    assert found.used[:, 30].all() and off(batch, found, 30) < 0.5 and off(batch, found, 39) < 0.5


@pytest.mark.parametrize("name", ["mbkf15", "mbkf21_car", "plus"])
def test_a_receiver_that_was_right_is_followed(name):
    """Fixes that stay 3 km off: the second that agrees is taken, and position follows to a metre."""
    batch = cars(name, 60)
    moved = shifted(batch, slice(30, 60), slice(0, 2), 3000.0)
    found = solved(moved, name)
    first = 30 + (int(HOLD_S) if name == "plus" else COARSE_PATIENCE) - 1
    assert not found.used[:, 30:first].any() and found.used[:, first:].all()
    target = batch.truth.p_n[:, -1, :2] + 3000
    assert (found.posterior.p_n[:, -1, :2] - target).norm(dim=-1).max() < 1.0


WRONG = ((30.0, 0.1), (3.0, 0.1), (1.0, 0.2))  # size [m] and share of positions that are wrong


@pytest.mark.parametrize("name", ["mbkf15_gated", "mbkf21_car_gated", pytest.param("plus", marks=pytest.mark.whole)])
def test_wrong_fixes_do_little(name):
    """Positions of 5 cm of which some are off by metres, alone: in an outage nearly as well as without them."""
    clean, wrong = cars(name, 150), []
    for size, share in WRONG:
        g = torch.Generator().manual_seed(1)
        hit = torch.rand(clean.gnss.shape[:2], generator=g) < share
        hit[:, :8] = False
        gnss = clean.gnss.clone()
        gnss[..., :3] += hit.unsqueeze(-1) * size * torch.randn(*hit.shape, 3, generator=g).to(gnss)
        wrong.append(replace(clean, gnss=gnss))
    batch = hidden(beside(clean, *wrong), slice(120, 150))
    error = (solved(batch, name).posterior.p_n - batch.truth.p_n)[..., :2].norm(dim=-1)
    before, end = error.unflatten(0, (4, -1)).amax(1)[:, [119, 149]].unbind(-1)
    assert (before[1:] < 0.5).all() and (end[1:] < 1.5 * end[0] + 2.0).all()


@pytest.mark.parametrize("name", ["mbkf15_gated", "plus"])
def test_fixes_noisier_than_claimed_are_used(name):
    """White noise of five times the 1σ is no outlier: what is usual is found in seconds, and few are left out."""
    batch = cars(name, 90)
    noise = torch.randn(batch.gnss.shape, generator=torch.Generator().manual_seed(2), dtype=batch.gnss.dtype)
    batch = replace(batch, gnss=batch.gnss + 4.9 * batch.gnss_std * noise)
    assert solved(batch, name).used[:, 20:].float().mean() > 0.9


def test_a_filter_that_is_itself_wrong_loses_one_fix():
    """Cars that slide as no car does lead the constraints 300 m astray in an outage, with 1σ of 2 m."""
    batch = hidden(scene(3, 60, seed=5), slice(20, 50))
    found = solved(batch, "mbkf21_car")
    assert off(batch, found, 49) > 60 and found.used[:, 51:].all()
    assert off(batch, found, 59) < 5


def test_the_coarse_gate_never_acts_on_good_fixes():
    """A minute, an outage of 30 s and what follows: to the bit the filter without it."""

    class Without(type(build_filter("mbkf15", IMU))):
        def screen_fix(self, memory, epoch):
            return memory, epoch

    for estimator in (build_filter("mbkf15", IMU), build_filter("mbkf21_car", IMU)):
        batch = hidden(cars("mbkf21_car" if estimator.sources else "mbkf15", 90), slice(40, 70))
        bare = Without(**{name: getattr(estimator, name) for name in estimator.__dataclass_fields__})
        with torch.inference_mode():
            a, b = integrate(batch, estimator), integrate(batch, bare)
        assert torch.equal(a.posterior.p_n, b.posterior.p_n) and torch.equal(a.used, b.used)


def test_the_coarse_limit_by_hand():
    """20 · √(P + R + 2²): 1σ of 3 m in the filter's position and 4 m in the fix's are 20 √29 m."""
    batch = scene(1, 1)
    epoch = epoch_of(batch, batch.start, ImuError(batch.imu.new_zeros(1, 6)))
    used = torch.tensor([[True] * 3 + [False] * 3])
    P = torch.zeros(1, 15, 15, dtype=torch.float64)
    P[0, 0, 0] = 9.0
    limit = COARSE_SIGMAS * (9 + 16 + COARSE_FLOOR[0] ** 2) ** 0.5
    for z0, kept in ((0.999 * limit, True), (1.001 * limit, False)):
        z = torch.zeros(1, 6, dtype=torch.float64)
        z[0, 0] = z0
        fix = Fix(z, torch.full_like(z, 4.0), used, None)
        gate = CoarseGate()
        _, screened, after = gate.screen_fix(gate.begin(z), epoch._replace(z=z, fix=fix), P, fix.std.square())
        assert bool(screened.used[0, 0]) is kept and float(screened.z[0, 0]) == (z0 if kept else 0.0)
        assert torch.equal(after, P)


def stopped_receiver(batch, epochs: slice, velocity: float = math.nan):
    """Fixes whose position stays that of the first of these epochs, with another velocity or none."""
    gnss, valid = batch.gnss.clone(), batch.gnss_valid.clone()
    gnss[:, epochs, :3] = gnss[:, epochs.start, None, :3]
    gnss[:, epochs, 3:] = 0.0 if math.isnan(velocity) else velocity
    valid[:, epochs, 3:] &= not math.isnan(velocity)
    return replace(batch, gnss=gnss, gnss_valid=valid)


@pytest.mark.parametrize("name", ["mbkf15", "mbkf21_car", "plus"])
@pytest.mark.parametrize("velocity", [math.nan, 0.0])
def test_a_position_that_stays_while_the_car_moves_is_not_used(name, velocity):
    """For half a minute, without a velocity or with one of zero: the solution without these fixes."""
    batch = cars(name, 60)
    frozen = stopped_receiver(batch, slice(29, 59), velocity)
    frozen.gnss[:, 29], frozen.gnss_valid[:, 29] = batch.gnss[:, 29], batch.gnss_valid[:, 29]
    both = solved(beside(frozen, hidden(batch, slice(30, 59))), name)
    found, without = both.posterior.p_n.split(3)
    assert not both.used[:3, 30:59].any() and both.used[:3, 59].all()
    assert (found - without)[:, :59].abs().max() < (1.0 if name == "plus" else 1e-9)


@pytest.mark.parametrize("name", ["mbkf15", "mbkf21_car"])
def test_a_stationary_car_may_have_a_receiver_that_holds_its_position(name):
    """A minute at rest with the same fix again and again: all are used."""
    batch = slipping(3, 120, (0.0,) * 5, stop=60.0)
    held = stopped_receiver(batch, slice(62, 120), 0.0)
    assert solved(held, name).used.all()


def positions_alone(batch):
    """As of a receiver that gives no velocities."""
    return replace(batch, gnss_valid=batch.gnss_valid & (torch.arange(6) < 3))


def extrapolated(batch, epochs: slice, alone: bool = False):
    """Fixes that go on from the first of these epochs with its velocity, as of a receiver in a tunnel; or with the one
    that led to it, where positions are ``alone``."""
    gnss = batch.gnss.clone()
    age = torch.arange(epochs.stop - epochs.start, dtype=gnss.dtype)[:, None]
    first = gnss[:, epochs.start, None]
    velocity = first[..., :3] - gnss[:, epochs.start - 1, None, :3] if alone else first[..., 3:]
    gnss[:, epochs, :3], gnss[:, epochs, 3:] = first[..., :3] + age * velocity, velocity
    return positions_alone(replace(batch, gnss=gnss)) if alone else replace(batch, gnss=gnss)


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("name", ["mbkf15", "mbkf21_car", "plus"])
def test_fixes_that_a_receiver_extrapolates_are_not_used(name, alone):
    """For ten seconds in a bend: after the first second or two nearly the solution without them."""
    batch = cars(name, 60)
    coasting = extrapolated(batch, slice(40, 50), alone)
    right = positions_alone(batch) if alone else batch
    both = solved(beside(coasting, hidden(right, slice(41, 50))), name)
    found, without = both.posterior.p_n.split(3)
    off = (coasting.gnss[:, 49, :2] - batch.truth.p_n[:, 49, :2]).norm(dim=-1)
    assert off.min() > 8.0 and not both.used[:3, 43:50].any() and both.used[:3, 50:].all()
    assert (found - without)[:, 49, :2].norm(dim=-1).max() < (0.2 if alone else 0.1) * off.max()


@pytest.mark.parametrize("how", ["noise", "fades", "coarse positions"])
@pytest.mark.parametrize("name", ["mbkf15_gated", "mbkf21_car_gated", "plus"])
def test_extrapolated_fixes_whose_velocity_changes_are_not_followed(name, how):
    """For eight seconds in a bend, with 3 cm/s of noise or ever slower, in a filter that has agreed with its fixes:
    nearly the solution without them, and the first true fixes count again. Likewise where the positions alone pass."""
    batch = cars(name, 60)
    if how == "coarse positions":
        batch.gnss_std[..., :3] = 1.5
    coasting = extrapolated(batch, slice(40, 49))
    gnss, age = coasting.gnss.clone(), torch.arange(9.0, dtype=batch.gnss.dtype)[:, None]
    if how == "fades":
        velocity = gnss[:, 40:49, 3:] * 0.97**age
        gnss[:, 41:49, :3] = gnss[:, 40:41, :3] + (velocity[:, 1:]).cumsum(1)
        gnss[:, 40:49, 3:] = velocity
    else:
        g = torch.Generator().manual_seed(1)
        gnss[:, 41:49, 3:] += 0.03 * torch.randn(len(gnss), 8, 3, generator=g, dtype=gnss.dtype)
    both = solved(beside(replace(coasting, gnss=gnss), hidden(batch, slice(41, 49))), name)
    found, without = both.posterior.p_n.split(3)
    off = (gnss[:, 48, :2] - batch.truth.p_n[:, 48, :2]).norm(dim=-1)
    assert off.min() > 8.0 and both.used[:3, 50:].all()
    assert both.used[:3, 42:49].sum() <= 3
    assert (found - without)[:, 48, :2].norm(dim=-1).max() < 0.1 * off.max()


def test_a_step_that_lasts_some_seconds_is_not_followed():
    """Positions 3 m off for eight seconds: all are refused, and none afterwards. Of 15 s the last ones are followed;
    so is the second of a step in the first 20 s, or in the seconds after an outage of 10 s."""
    batch = cars("mbkf15_gated", 90)

    def used(first: int, last: int, data=batch):
        return solved(shifted(data, slice(first, last), slice(0, 2), 3.0), "mbkf15_gated").used

    assert not used(60, 68)[:, 60:68].any() and used(60, 68)[:, 68:].all()
    long = used(60, 75)
    assert not long[:, 60:69].any() and long[:, 69:75].all()
    early = used(12, 30)
    assert not early[:, 12].any() and early[:, 13:30].all()
    after = used(60, 90, hidden(batch, slice(48, 60)))
    assert after[:, 61:].all()
    seldom = used(60, 68, hidden(batch, torch.arange(90) % 4 > 0))[:, ::4]
    assert not seldom[:, 15:17].any() and seldom[:, 17:].all()


def test_velocities_that_repeat_are_no_extrapolation_where_the_car_keeps_its_own():
    """At constant speed straight on all fixes count, and of a car that speeds up those with another velocity."""
    batch = cars("mbkf15", 30)
    epoch = epoch_of(batch, batch.start, ImuError(batch.imu.new_zeros(len(batch.imu), 6)))
    P = 1e-6 * torch.eye(15, dtype=torch.float64).repeat(len(batch.imu), 1, 1)
    still = epoch._replace(
        window=epoch.window._replace(end=epoch.start), fix=epoch.fix._replace(used=epoch.used | True)
    )
    faster, slower = (epoch.start._replace(v_n=epoch.start.v_n + x) for x in (0.5, -0.5))
    value = torch.zeros_like(still.fix.value)
    value[:, 3] = 10.0
    state = Coasting.begin(P)
    for end, metres, expected in ((epoch.start, 0.0, (0, 0)), (epoch.start, 1.0, (0, 0)), (faster, 2.0, (1, 1)),
                                  (slower, 3.0, (1, 1)), (epoch.start, 3.0, (0, 1))):  # fmt: skip
        fix = value.clone()
        fix[:, :2] = value[:, :2] + metres * value[:, 3:5]
        state = state.update(
            still._replace(window=still.window._replace(end=end), fix=still.fix._replace(value=fix)), P
        )
        assert (state.found == torch.tensor(expected, dtype=torch.bool)).all()
    alone = still.fix._replace(value=value, used=still.fix.used & (torch.arange(6) < 3))
    assert not state.update(still._replace(fix=alone), P).found.any()  # a position without a velocity
    value[:, 3:5] += 0.02
    assert not state.update(still._replace(fix=still.fix._replace(value=value)), P).found.any()


def test_of_positions_alone_means_are_compared():
    """A car that brakes at the end of a second has a position as of constant speed; a second later it is none. Nor is
    one a repetition that comes six seconds after another, or beside a velocity."""
    batch = cars("mbkf15", 30)
    epoch = epoch_of(batch, batch.start, ImuError(batch.imu.new_zeros(len(batch.imu), 6)))
    P = 1e-6 * torch.eye(15, dtype=torch.float64).repeat(len(batch.imu), 1, 1)
    north = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)

    def at(metres: float, before: float, mean: float, after: float, moves: bool = False):
        """An interval with the INS's speeds, and a fix so far from the origin."""
        start = epoch.start._replace(v_n=0 * epoch.start.v_n + before * north)
        end = start._replace(p_n=start.p_n + mean * epoch.span_s * north, v_n=0 * start.v_n + after * north)
        value = torch.cat((0 * end.p_n + metres * north, 0 * end.v_n + 10.0 * north), -1)
        used = torch.ones_like(epoch.fix.used) & ((torch.arange(6) < 3) | moves)
        fix = epoch.fix._replace(value=value, used=used)
        assert epoch.span_s == 1.0
        return epoch._replace(start=start, window=epoch.window._replace(end=end), fix=fix)

    def refused(*epochs) -> list[bool]:
        state, found = Coasting.begin(P), []
        for one in epochs:
            state = state.update(one, P)
            assert (state.found == state.found[:1, :1]).all()
            found.append(bool(state.found[0, 0]))
        return found

    steady = [at(10.0 * k, 10.0, 10.0, 10.0) for k in range(3)]
    brakes, slower = at(30.0, 10.0, 10.0, 9.0), at(40.0, 9.0, 8.5, 8.0)
    assert refused(*steady, brakes, slower) == [False, False, False, False, True]
    assert refused(*steady, brakes, at(38.5, 9.0, 8.5, 8.0)) == 5 * [False]
    gap = [slower._replace(fix=slower.fix._replace(used=slower.fix.used & False)) for _ in range(6)]
    assert refused(*steady, *gap, at(90.0, 8.0, 8.0, 8.0)) == 10 * [False]
    assert refused(*steady[:2], at(20.0, 10.0, 10.0, 10.0, moves=True), at(30.0, 9.0, 8.5, 8.0)) == 4 * [False]


@pytest.mark.parametrize("name", ["mbkf15_gated", "mbkf21_car_gated", "plus"])
@pytest.mark.parametrize("wrong", ["zero", "5 m/s more"])
def test_wrong_velocities_are_not_followed_where_positions_contradict_them(name, wrong):
    """For half a minute, beside positions of 5 cm: nearly the solution of the positions alone, and no position is
    refused."""
    batch = cars(name, 80)
    gnss, valid = batch.gnss.clone(), batch.gnss_valid.clone()
    gnss[:, 40:70, 3:] = 0.0 if wrong == "zero" else gnss[:, 40:70, 3:] + gnss.new_tensor([3.0, 4.0, 0.0])
    valid[:, 40:70, 3:] = False
    both = beside(replace(batch, gnss=gnss), replace(batch, gnss_valid=valid))
    found = solved(both, name)
    error = (found.posterior.p_n - both.truth.p_n)[:, 40:, :2].norm(dim=-1)
    assert found.used.all() and error[:3].max() < error[3:].max() + 0.1
