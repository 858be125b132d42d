"""The weights that come with the package: whole, small, with a card, and a filter wherever a name is asked for."""

from dataclasses import replace

import pytest
import torch
import yaml

from dlkf.command.composing import compose_command
from dlkf.data.augmentation import SensorDegradation, degrade_sensors
from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.plus import PlusConfig, PlusFilter
from dlkf.filters.shipped import WEIGHTS_FOLDER, shipped_folder, trained_filter
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.tracking.models import resolve_model, short_name

from .scene import IMU
from .test_constraints import slipping


def test_it_is_there_small_and_tells_what_it_was_trained_on():
    folder = shipped_folder("plus")
    assert folder == WEIGHTS_FOLDER / "plus"
    assert (folder / "weights.safetensors").stat().st_size < 2e6
    card = yaml.safe_load((folder / "card.yaml").read_text())
    assert card["datasets"] and (folder / "card.md").read_text().startswith("# plus")
    assert shipped_folder("mbkf21") is None and shipped_folder("../plus") is None


def test_model_plus_is_a_filter_like_any_other():
    assert isinstance(resolve_model("plus", IMU), PlusFilter) and short_name("plus") == "plus"


def test_the_preset_trains_the_filter_that_ships():
    settings = compose_command("train", "filter@model=plus")["model"]
    assert settings["base"] == trained_filter("plus").config.base == PlusConfig.base


def test_plus_imu_takes_biases_scale_factors_and_misalignments_of_a_preset():
    """And nothing else: its noise is that of ``plus``."""
    plus, known = trained_filter("plus"), resolve_model("plus_imu", IMU)
    assert isinstance(known, PlusFilter) and short_name("plus_imu") == "plus_imu" and known.card == plus.card
    for name in ("accel", "gyro"):
        sensor, unknown, given = getattr(known.imu, name), getattr(plus.imu, name), getattr(IMU, name)
        expected = {k: getattr(given, k) for k in ("turn_on_bias", "scale_factor", "misalignment")}
        assert sensor == replace(unknown, **expected) != unknown
    assert all(torch.equal(a, b) for a, b in zip(known.state_dict().values(), plus.state_dict().values(), strict=True))
    assert known.tuning == plus.tuning


@pytest.mark.whole
def test_without_any_fix_a_known_imu_drifts_less():
    """Nothing else shows a bias along the road: an unknown IMU's acceleration may well be one."""
    batch = slipping(24, 60, (0.0, 0.0, 0.8, 0.0, 0.0))
    unbiased = batch.imu - batch.true_imu_error.unsqueeze(2)
    batch = replace(batch, imu=unbiased, available=torch.zeros_like(batch.available))
    good = ImuSpec("good", SensorErrors(1e-3, turn_on_bias=1e-3), SensorErrors(1e-5, turn_on_bias=1e-5))
    with torch.no_grad():
        a, b = (integrate(batch, f) for f in (resolve_model("plus_imu", good), trained_filter("plus")))
    off = [(s.posterior.p_n - batch.truth.p_n)[:, -1, :2].norm(dim=-1) for s in (a, b)]
    assert off[0].log().mean() < off[1].log().mean() - 0.5
    assert (a.std[:, -1, :2] < 0.5 * b.std[:, -1, :2]).all()


@pytest.mark.commands
@pytest.mark.whole
def test_it_finds_out_what_imu_it_has():
    """An IMU far noisier than it takes an unknown one for: its own σ in the outage says so. Cars that move as the
    constraints have it, which here decide the error, are no further off than with its classical filter."""
    g = torch.Generator().manual_seed(0)
    batch = slipping(120, 110, (0.02, -0.01, 0.8, 0.004, 0.004))  # of 24 the ratio has 18 % 1σ, of these 8 %
    rough = SensorDegradation(share=1.0, accel_noise=(0.02, 0.03), gyro_noise=(3e-3, 5e-3), shaken=0.0, gnss=0.0)
    batch = degrade_sensors(batch, rough, g)
    batch.available[:, 60:] = False
    model = trained_filter("plus")
    with torch.no_grad():
        a, b = (integrate(batch, f) for f in (model, build_filter("mbkf21_car", model.imu, tuning=model.tuning)))
    off = [(s.posterior.p_n - batch.truth.p_n)[:, -1, :2].norm(dim=-1).log().mean().exp() for s in (a, b)]
    assert off[0] < 1.05 * off[1]
    assert (a.std[:, -1, :2] > b.std[:, -1, :2]).float().mean() > 0.9


@pytest.mark.parametrize("rate", [25, 50, 200])
def test_any_rate(rate):
    """The same drive at another rate of the IMU: much the same solution (the bands above 12 Hz are empty at 25 Hz)."""
    batch = slipping(2, 20, (0.0, 0.0, 0.0, 0.0, 0.0))
    x = batch.imu
    x = x.unflatten(2, (-1, 50 // rate)).mean(3) if rate < 50 else x.repeat_interleave(rate // 50, 2)
    other = replace(batch, imu=x, dt=1 / rate)
    with torch.no_grad():
        s = integrate(other, trained_filter("plus"))
    assert (s.posterior.p_n - batch.truth.p_n)[:, -1].norm(dim=-1).max() < 1.0
