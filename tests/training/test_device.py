"""What a GPU would refuse, shown without one: the same training on a device that does not mix with the CPU's memory."""

from pathlib import Path

import lightning as L
import pytest
import torch
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.strategies import SingleDeviceStrategy

from dlkf.command.composing import compose_command
from dlkf.data.datamodule import DriveDataModule
from dlkf.data.masks import Outage
from dlkf.filters.integration import integrate
from dlkf.filters.saved import build_learned_filter, load_filter, parse_learned_settings
from dlkf.training.callbacks.checkpoints import ResumePoint
from dlkf.training.fit import fit
from dlkf.training.loss import LossConfig, weighted_loss
from dlkf.training.module import FilterTraining
from tests.cars import car_batch
from tests.drives import drives_in
from tests.elsewhere import DEVICE, Elsewhere

from .test_resume import fit_of, make_settings, settings


class Pretended(CPUAccelerator):
    """Lightning's word for :class:`Elsewhere`."""

    def setup_device(self, device):
        assert device == DEVICE


LOSSES = {"dlkf": LossConfig(), "plus": LossConfig(prior=0.0, posterior=0.0, outage=1.0, likelihood=1.0)}
SIZES = {"dlkf": {"lstm_hidden": 16, "lstm_layers": 2, "dense": [16, 8], "dropout": 0.0}, "plus": {"hidden": 8}}


@pytest.mark.parametrize(
    ("kind", "more"),
    [("dlkf", {}), ("dlkf", {"outage_mode": "run", "frame": "heading", "imu_error": "affine"}), ("plus", {})],
)
@pytest.mark.whole
def test_loss_and_gradients_are_the_cpus_and_the_host_waits_for_nothing(kind, more):
    """Through another form of every loop, so to rounding in float64; a wait would be one in every epoch."""
    batch = car_batch(4, 12, 50)
    batch.available[1::2, 4:9] = False

    def step(batch, device):
        torch.manual_seed(1)
        settings = parse_learned_settings({"kind": kind, "network": SIZES[kind], **more})
        filter_ = build_learned_filter(settings).double().to(device)
        loss = LOSSES[kind](integrate(batch, filter_, keep_covariances=kind == "plus"), batch)
        weighted_loss(loss, {}).backward()
        return loss, {k: p.grad.to("cpu") for k, p in filter_.named_parameters() if p.grad is not None}

    ours, gradients = step(batch, "cpu")
    with Elsewhere() as device:
        there = batch.to(DEVICE)
        device.waits.clear()
        losses, moved = step(there, DEVICE)
        copied = len(moved)
        assert sum(device.waits.values()) - copied == 2, device.waits  # late fixes? a lever arm?
        for name, loss in losses.items():
            assert float(loss.detach()) == pytest.approx(float(ours[name].detach()), rel=1e-9), name
    assert moved.keys() == gradients.keys()
    for name, gradient in gradients.items():
        assert torch.allclose(moved[name], gradient, rtol=1e-6, atol=1e-9 * float(gradient.abs().max())), name


@pytest.mark.parametrize(("kind", "operations"), [("dlkf", 620), ("plus", 3620)])
def test_an_epoch_is_as_many_operations_as_the_docs_tell(kind, operations):
    """Forth and back, with the networks as they are by default; the difference of two lengths leaves out what is done
    once a batch. A loop over samples or segments would make them many."""
    counts = []
    for T in (3, 5):
        with Elsewhere() as device:
            filter_ = build_learned_filter(parse_learned_settings({"kind": kind})).to(DEVICE)
            batch = car_batch(2, T, 50, dtype=torch.float32).to(DEVICE)
            device.work = 0
            losses = LOSSES[kind](integrate(batch, filter_, keep_covariances=kind == "plus"), batch)
            weighted_loss(losses, {}).backward()
            counts.append(device.work)
    assert (counts[1] - counts[0]) / 2 == pytest.approx(operations, rel=0.1)


@pytest.fixture(scope="module")
def dataset(once) -> Path:
    """A quarter of an hour: of less, a weight may have a gradient of rounding's size, whose sign decides its step."""
    size = ["simulated@dataset=one_imu", "dataset.hours=0.25", "dataset.drive_minutes=3", "seed=1"]
    config = compose_command("simulate", *size)
    return once("quarter", lambda folder: drives_in(config, folder / "quarter")) / "quarter"


@pytest.mark.commands
@pytest.mark.whole
def test_a_whole_training_runs_there(dataset, tmp_path, monkeypatch):
    """Curriculum, masks, loss weights, validation and the kept weights, which are those of the CPU to rounding."""
    given = settings(max_epochs=2, validate_every=2)
    given["callbacks"]["curriculum"] |= {"warm_s": 5.0, "full_s": 10.0}
    given["callbacks"]["outage"] |= {"duration_s": [2.0, 3.0], "before_s": 3.0}

    def trained(name: str):
        segments = DriveDataModule(
            [dataset], batch_size=40, length_s=10.0, eval_length_s=15.0, fractions=(0.6, 0.2, 0.2),
            eval_outage=Outage(6.0, 5.0),
        )  # fmt: skip
        return load_filter(fit(fit_of(given), segments, tmp_path / name, False)).state_dict()

    trainer, here = L.Trainer, trained("here")

    def pretended(**given):
        return trainer(**given | {"accelerator": "auto", "strategy": SingleDeviceStrategy(DEVICE, Pretended())})

    monkeypatch.setattr("dlkf.training.fit.L.Trainer", pretended)
    monkeypatch.setattr(ResumePoint, "on_train_epoch_end", lambda *_: None)  # torch.save does not know the device
    with Elsewhere():
        there = trained("there")
    start = FilterTraining(
        make_settings().model, make_settings().loss, make_settings().descent, seed=3
    ).filter.state_dict()
    for name, weight in here.items():
        assert torch.allclose(weight, there[name], rtol=0, atol=3e-4), name
    moved = max(float((here[name] - start[name]).abs().max()) for name in here if name.endswith("weight"))
    assert moved > 3e-3  # ten times what rounding may do
