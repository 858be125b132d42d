"""The experiment ``plus`` through the same trainer as any learned filter, and fine-tuning of trained weights."""

from dataclasses import replace

import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.command.composing import compose_command
from dlkf.data.drive import Batch
from dlkf.filters.integration import integrate
from dlkf.filters.plus import PlusConfig, PlusFilter
from dlkf.filters.saved import load_filter
from dlkf.training.callbacks.sensor_degradation import SensorDegradationCallback
from dlkf.training.fit import fit
from dlkf.training.loss import LossConfig, pva_losses, weighted_loss
from dlkf.training.module import FilterTraining
from dlkf.training.optimization import OptimizationPlan, OptimizerSettings, SchedulerSettings
from tests.training.test_resume import fit_of

from .test_resume import data

PLAN = OptimizationPlan(OptimizerSettings(1e-3, 1.0, 0.0), SchedulerSettings())


def settings(*overrides: str) -> dict:
    words = ["+experiment=plus", "data.datasets=[data/none]", "model.network.hidden=8", *overrides]
    config = compose_command("train", *words, "trainer.best_from_epoch=0")
    config["trainer"] |= {"max_epochs": 1, "validate_every": 1, "accelerator": "cpu"}
    config["callbacks"]["curriculum"] |= {"warm_s": 14.0, "full_s": 16.0}
    config["callbacks"]["outage"] |= {"duration_s": [2.0, 5.0], "before_s": 5.0}
    return config


@pytest.mark.whole
def test_it_trains_is_saved_and_fine_tuned(dataset, tmp_path):
    best = fit(fit_of(settings()), data(dataset), tmp_path / "fresh", False)
    model = load_filter(best)
    assert isinstance(model, PlusFilter) and model.network.noise.weight.abs().sum() > 0
    again = settings()
    again["finetune"], again["optimizer"]["lr"] = str(best), 0.0
    tuned = load_filter(fit(fit_of(again), data(dataset), tmp_path / "tuned", False))
    assert all(torch.equal(a, b) for a, b in zip(model.state_dict().values(), tuned.state_dict().values(), strict=True))


def test_its_loss_knows_outages_and_its_own_covariance(dataset):
    """A filter surer than it is right is told so; an error in the outage costs as its logarithm does."""
    module = data(dataset)
    module.setup()
    batch: Batch = module.batches("val")[0]
    config = LossConfig(prior=0.0, posterior=0.0, outage=1.0, likelihood=1.0)
    model = PlusFilter(_small()).eval()
    with torch.no_grad():
        solution = integrate(batch, model, keep_covariances=True)
        losses = pva_losses(solution, batch, config)
        assert set(losses) == {"outage", "likelihood"}
        assert float(weighted_loss(losses, {})) == pytest.approx(float(sum(losses.values())))
        P = solution.covariances.updated
        sure = solution.covariances._replace(updated=P / 1e4)
        object.__setattr__(solution, "covariances", sure)
        assert pva_losses(solution, batch, config)["likelihood"] > losses["likelihood"]


def test_sensor_degradation_takes_its_own_keys_alone():
    assert SensorDegradationCallback(share=0.1).rough.share == 0.1
    with pytest.raises(InputError, match=r"callbacks\.sensor_degradation: unknown key shaar"):
        SensorDegradationCallback(shaar=0.1)


def test_a_wheel_of_the_segments_is_used_and_the_weights_stay_the_same(dataset):
    """Speeds of the reference move the solution, rows that are blank do not, and the gradient reaches the network."""
    module = data(dataset)
    module.setup()
    batch = module.batches("val")[0]
    truth = batch.truth
    forward = (truth.C_nb[..., 0] * truth.v_n).sum(-1)
    rows = torch.stack((forward, *(torch.full_like(forward, x) for x in (0.05, 0.0, 0.0, 1.0))), -1)
    training = FilterTraining(_small(), LossConfig(prior=0.0, posterior=0.0, outage=1.0), PLAN)
    with torch.no_grad():
        alone = training._run(batch).posterior.p_n
        blank = training._run(replace(batch, aids={"speed": 0 * rows})).posterior.p_n
    solution = training._run(replace(batch, aids={"speed": rows}))
    assert torch.equal(alone, blank) and float((solution.posterior.p_n.detach() - alone).abs().max()) > 0.01
    solution.posterior.p_n.square().sum().backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in training.filter.parameters())


def test_without_its_own_weights_fine_tuning_says_so(dataset, tmp_path):
    wrong = settings() | {"finetune": str(tmp_path / "none")}
    with pytest.raises(InputError, match=r"config\.yaml"):
        fit(fit_of(wrong), data(dataset), tmp_path / "run", False)


def _small() -> PlusConfig:
    return PlusConfig.from_mapping({"network": {"hidden": 8}})
