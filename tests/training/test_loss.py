"""The loss: closed form, masks, gradient."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.model_based import Ins
from dlkf.filters.plus import PlusConfig
from dlkf.navigation.attitude import rotation_from_vector
from dlkf.navigation.state import NavState
from dlkf.training.loss import LossConfig, build_loss, likelihood_term, pva_losses, weighted_loss
from dlkf.training.module import FilterTraining
from dlkf.training.optimization import OptimizationPlan, OptimizerSettings, SchedulerSettings
from tests.filters.scene import IMU, scene


def shifted(batch, solution, metres: float):
    """A solution that is off by a constant north and right in all else."""
    p = batch.truth.p_n.clone()
    p[..., 0] -= metres
    state = NavState(p, batch.truth.v_n, batch.truth.C_nb)
    return replace(solution, prior=state, posterior=state)


def test_smooth_l1_in_closed_form():
    """0.5 e² below the scale, e − 0.5 above it, over three axes (paper.md 2.8)."""
    batch = scene(2, 5)
    solution = integrate(batch, Ins())
    for metres, scale, expected in ((0.4, 1.0, 0.5 * 0.16 / 3), (3.0, 1.0, 2.5 / 3), (3.0, 2.0, 1.0 / 3)):
        losses = pva_losses(shifted(batch, solution, metres), batch, LossConfig(position_scale=scale))
        assert abs(float(losses["position"]) - expected) < 1e-9
        assert abs(float(losses["velocity"])) < 1e-12 and abs(float(losses["attitude"])) < 1e-12
    assert float(weighted_loss(losses, {"position": 2.0, "velocity": 1.0, "attitude": 1.0})) == 2 * float(
        losses["position"]
    )


def test_velocity_and_attitude_in_closed_form():
    """At the default scales, 0.1 m/s and 0.02 rad: e − 0.5 for 0.5 m/s along one axis, 0.5 e² for 0.01 rad."""
    batch = scene(2, 5)
    v = batch.truth.v_n.clone()
    v[..., 1] += 0.5
    turn = torch.zeros_like(v)
    turn[..., 2] = 0.01
    state = NavState(batch.truth.p_n, v, rotation_from_vector(turn) @ batch.truth.C_nb)
    losses = pva_losses(replace(integrate(batch, Ins()), prior=state, posterior=state), batch, LossConfig())
    assert float(losses["position"]) == 0.0
    assert float(losses["velocity"]) == pytest.approx(4.5 / 3, rel=1e-9)
    assert float(losses["attitude"]) == pytest.approx(0.5 * 0.25 / 3, rel=1e-6)


def test_likelihood_is_that_of_students_t():
    """½ log|P| + ½ (ν + 2) log(1 + eᵀP⁻¹e / ν), ν = 8, of a horizontal error with correlated components."""
    batch = scene(1, 4)
    batch = replace(batch, available=torch.tensor([[True, True, False, False]]))
    solution = shifted(batch, integrate(batch, build_filter("mbkf15", IMU), keep_covariances=True), 3.0)
    p = solution.posterior.p_n.clone()
    p[..., 1] += 2.0
    P = torch.tensor([[4.0, 1.5], [1.5, 9.0]], dtype=torch.float64)
    updated = solution.covariances.updated.clone()
    updated[..., :2, :2] = P
    solution = replace(
        solution,
        posterior=solution.posterior._replace(p_n=p),
        covariances=solution.covariances._replace(updated=updated),
    )
    e = torch.tensor([-3.0, 2.0], dtype=torch.float64)
    expected = 0.5 * P.logdet() + 5 * torch.log1p(e @ torch.linalg.solve(P, e) / 8)
    # the floor of 1e-4 m² under the variances shifts it by some 1e-5
    assert float(likelihood_term(solution, batch, batch.truth_valid)) == pytest.approx(float(expected), abs=1e-4)


def test_unknown_truth_does_not_count_and_gives_no_nan():
    batch = scene(3, 8)
    C = batch.truth.C_nb.clone()
    C[0] = torch.nan
    p = batch.truth.p_n.clone()
    p[1, 4:] = torch.nan
    known = torch.ones(3, 8, dtype=torch.bool)
    attitude, position = known.clone(), known.clone()
    attitude[0], position[1, 4:] = False, False
    holed = replace(batch, truth=NavState(p, batch.truth.v_n, C), attitude_valid=attitude, truth_valid=position)
    imu = batch.imu.clone().requires_grad_()
    losses = pva_losses(integrate(replace(holed, imu=imu), Ins()), holed, LossConfig())
    weighted_loss(losses, dict.fromkeys(losses, 1.0)).backward()
    assert all(v.isfinite() for v in losses.values()) and imu.grad.isfinite().all()


def test_prior_and_posterior_shares():
    batch = scene(2, 6)
    solution = integrate(batch, Ins())
    good = NavState(*batch.truth)
    mixed = replace(shifted(batch, solution, 3.0), posterior=good)
    half = pva_losses(mixed, batch, LossConfig())["position"]
    prior_only = pva_losses(mixed, batch, LossConfig(posterior=0.0))["position"]
    assert abs(float(half) * 2 - float(prior_only)) < 1e-9
    assert float(pva_losses(mixed, batch, LossConfig(prior=0.0))["position"]) < 1e-12


@pytest.mark.parametrize("metres", [1e5, torch.inf, torch.nan])
def test_a_segment_that_diverged_counts_in_no_term(metres):
    """Every term is that of the other segments alone; the outage too, whose logarithm would still be 23 of 1e5 m."""
    batch, config = scene(3, 8), LossConfig(outage=1.0, likelihood=0.1)
    batch = replace(batch, available=batch.available & (torch.arange(8) < 5))
    solution = integrate(batch, build_filter("mbkf15", IMU), keep_covariances=True)
    p = solution.posterior.p_n.clone()
    p[1, 6:] += metres
    spoilt = replace(solution, posterior=solution.posterior._replace(p_n=p))
    others = batch.select(torch.tensor([0, 2]))
    expected = pva_losses(integrate(others, build_filter("mbkf15", IMU), keep_covariances=True), others, config)
    losses = pva_losses(spoilt, batch, config)
    assert set(losses) == {"outage", "likelihood", "position", "velocity", "attitude"}
    for term, loss in losses.items():
        assert float(loss) == pytest.approx(float(expected[term]), rel=1e-12), term


class Late:
    """A loss of one's own: the position error at the end of the segment alone."""

    def __init__(self, scale: float = 1.0):
        self.scale = scale

    def __call__(self, solution, batch):
        return {"late": ((solution.posterior.p_n - batch.truth.p_n)[:, -1] / self.scale).square().mean()}


def test_a_loss_of_one_s_own_takes_its_settings_and_no_others():
    batch = scene(2, 5)
    solution = integrate(batch, Ins())
    own = {"_target_": f"{__name__}.Late", "scale": 2.0, "position_scale": 1.0}
    quarter, whole = (build_loss(own | {"scale": s})(solution, batch)["late"] for s in (2.0, 1.0))
    assert float(whole) == pytest.approx(4 * float(quarter)) and float(whole) > 0
    assert float(weighted_loss({"late": whole}, {"position": 5.0})) == float(whole)
    with pytest.raises(InputError, match="takes no colour"):
        build_loss(own | {"colour": 1})
    with pytest.raises(InputError, match="PYTHONPATH"):
        build_loss({"_target_": "nowhere.Late"})
    with pytest.raises(InputError, match="unknown key colour"):
        build_loss({"colour": 1})


def test_one_of_the_three_losses_can_be_left_out():
    """R124: training without an attitude reference."""
    batch = scene(2, 5)
    losses = pva_losses(integrate(batch, Ins()), batch, LossConfig())
    without = weighted_loss(losses, LossConfig(attitude=0.0).factors)
    assert float(losses["attitude"]) > 0 and float(without) == float(losses["position"] + losses["velocity"])


def test_fixed_factors_multiply_the_adaptive_weights(monkeypatch):
    """The weights are computed from losses without the factor, else they would divide it out again."""
    monkeypatch.setattr(FilterTraining, "trainer", SimpleNamespace(global_rank=0, world_size=1))
    batch, plan = scene(2, 5), OptimizationPlan(OptimizerSettings(1e-3, 1.0, 0.0), SchedulerSettings())
    logged, totals = [], []
    for factor in (1.0, 3.0):
        model = PlusConfig.from_mapping({"network": {"hidden": 8}})
        training = FilterTraining(model, LossConfig(velocity=factor), plan)
        training._run, training.log_dict = lambda b: integrate(b, Ins()), lambda values, **_: logged.append(values)
        training.loss_weights = lambda: {"position": 1.0, "velocity": 2.0, "attitude": 0.5}
        totals.append(float(training.training_step(batch, 0)))
    velocity = [float(values["train/velocity_loss"]) for values in logged]
    assert velocity[0] == velocity[1] > 0
    assert totals[1] - totals[0] == pytest.approx((3 - 1) * 2.0 * velocity[0], rel=1e-9)
