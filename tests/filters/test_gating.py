"""The gate's verdict on one position, by hand: when refused fixes agree, and how far P is then opened."""

from dataclasses import replace

import pytest
import torch

from dlkf.filters.build import build_filter
from dlkf.filters.gating import (
    AGREEMENT_SPEED,
    COARSE_FLOOR,
    COARSE_PATIENCE,
    COARSE_SIGMAS,
    PATIENCE,
    CoarseGate,
    Gate,
    Verdict,
)
from dlkf.filters.integration import Fix, integrate
from dlkf.filters.shipped import trained_filter
from dlkf.navigation.calibration import ImuError

from .scene import IMU, scene
from .test_constraints import epoch_of, slipping


def judged(off: float, before: float, refused: int) -> tuple[float, Verdict]:
    """A position ``off`` [m] along north where S has 2 m (1σ), a second after one ``before`` [m] off that was the
    last of ``refused``; fixes of 1 cm. How many are refused now, and the verdict."""
    batch = scene(1, 1)
    epoch = epoch_of(batch, batch.start, ImuError(batch.imu.new_zeros(1, 6)))
    z, used = torch.zeros_like(epoch.z), torch.tensor([[True] * 3 + [False] * 3])
    z[0, 0] = off
    fix = Fix(z, torch.full_like(z, 0.01), used, None)
    gate = Gate(0.999)
    memory = gate.begin(epoch.z)
    memory.innovation[0, 0], memory.refused[0] = before, refused
    after, verdict = gate.judge(
        memory, epoch._replace(z=z, fix=fix), torch.diag_embed(torch.where(used, 4.0, 1.0).to(z)), fix.std.square()
    )
    return float(after.refused), verdict


def test_a_refused_position_agrees_with_one_as_far_off():
    """Within 6σ of both fixes, √6 cm (three axes each), and what 2 m/s make of the second between them."""
    limit = 6 * 0.01 * 6**0.5 + AGREEMENT_SPEED
    assert judged(50.0, 50.0 - limit + 0.01, 2)[0] == 3
    assert judged(50.0, 50.0 - limit - 0.01, 2)[0] == 1


def test_p_is_inflated_by_what_contradicts_it():
    """At the last of the agreeing refusals: by z² in itself, and all of it by the mean of z²/S over the components."""
    kept = judged(12.0, 12.0, PATIENCE - 2)[1]
    assert float(kept.factor) == 1.0 and not kept.shift.any() and not kept.passed.any()
    left, opened = judged(12.0, 12.0, PATIENCE - 1)
    assert left == PATIENCE and float(opened.factor) == pytest.approx(12.0**2 / 4 / 3)
    assert opened.shift[0].tolist() == [144.0, 0, 0, 0, 0, 0] and opened.passed[0].tolist() == [True] * 3 + [False] * 3
    P = torch.eye(9, dtype=opened.factor.dtype)[None]
    assert opened.inflated(P)[0].diagonal().tolist() == pytest.approx([156.0, *[12.0] * 8])


def test_a_filter_that_has_moved_follows_the_next_fixes_at_once():
    """Those that lie near where it moved to; one elsewhere waits, and each that passes the test counts against it."""
    after, followed = judged(9.0, 8.0, PATIENCE)
    assert after == PATIENCE and followed.passed[0, 0] and float(followed.shift[0, 0]) == 81.0
    assert judged(9.0, 8.0, PATIENCE - 2)[0] == PATIENCE - 1
    assert judged(1.0, 8.0, PATIENCE)[0] == PATIENCE - 1
    assert not judged(500.0, 8.0, PATIENCE)[1].passed.any()


def cars(name: str, epochs: int):
    """Cars that move as the filter's constraints say, where it has some."""
    return scene(3, epochs, seed=7) if name in ("mbkf15", "aekf") else slipping(3, epochs, (0.0,) * 5)


def shifted(batch, epochs: slice, components: slice, by: float):
    """Fixes off by so much in each of these components."""
    gnss = batch.gnss.clone()
    gnss[:, epochs, components] += by
    return replace(batch, gnss=gnss)


def hidden(batch, epochs: slice):
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
    found, without = solved(wrong, name), solved(hidden(batch, slice(50, 51)), name)
    assert not found.used[:, 50].any() and found.used[:, 51:].all()
    assert off(batch, found, 50) < off(batch, without, 50) + 1e-6
    assert torch.equal(found.posterior.p_n[:, 51:], without.posterior.p_n[:, 51:])


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
    first = 30 + COARSE_PATIENCE - 1
    assert not found.used[:, 30:first].any() and found.used[:, first:].all()
    target = batch.truth.p_n[:, -1, :2] + 3000
    assert (found.posterior.p_n[:, -1, :2] - target).norm(dim=-1).max() < 1.0


def test_a_filter_that_is_itself_wrong_loses_one_fix():
    """Cars that slide as no car does lead the constraints 300 m astray in an outage, with 1σ of 2 m."""
    batch = hidden(scene(3, 60, seed=5), slice(20, 50))
    found = solved(batch, "mbkf21_car")
    assert off(batch, found, 49) > 60 and found.used[:, 51:].all()
    assert off(batch, found, 59) < 5


def test_the_coarse_gate_never_acts_on_good_fixes():
    """A minute, an outage of 30 s and what follows: to the bit the filter without it."""

    class Without(type(build_filter("mbkf15", IMU))):
        def screened(self, memory, epoch):
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
        _, screened, after = gate.screened(gate.begin(z), epoch._replace(z=z, fix=fix), P)
        assert bool(screened.used[0, 0]) is kept and float(screened.z[0, 0]) == (z0 if kept else 0.0)
        assert torch.equal(after, P)
