"""The weights that come with the package: whole, small, with a card, and a filter wherever a name is asked for."""

from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
import yaml

from dlkf.command.simulated import composed_recipe
from dlkf.data.augmentation import Rough, roughen
from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.plus import PlusFilter
from dlkf.filters.shipped import WEIGHTS_FOLDER, shipped_folder, trained_filter
from dlkf.models import resolve_model, short_name
from dlkf.running.start import aligned_drives
from tests.drives import drive_in_memory

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


def test_it_finds_out_what_imu_it_has():
    """An IMU far noisier than it takes an unknown one for: in the outage it is told by its own σ, and is less wrong
    than its classical filter with the same beginning."""
    g = torch.Generator().manual_seed(0)
    batch = slipping(24, 110, (0.02, -0.01, 0.8, 0.004, 0.004))
    rough = Rough(share=1.0, accel_noise=(0.02, 0.03), gyro_noise=(3e-3, 5e-3), shaken=0.0, gnss=0.0)
    batch = roughen(batch, rough, g)
    batch.available[:, 60:] = False
    model = trained_filter("plus")
    with torch.no_grad():
        a, b = (integrate(batch, f) for f in (model, build_filter("mbkf21_car", model.imu, tuning=model.tuning)))
    off = [(s.posterior.p_n - batch.truth.p_n)[:, -1, :2].norm(dim=-1).log().mean().exp() for s in (a, b)]
    assert off[0] < off[1]
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


def test_the_speed_it_hears_is_that_of_the_car_that_shakes():
    """The same drive twice, five minutes each: its vibration tells the speed, with it gone nothing does, and the 1σ of
    the speed says so. The network never saw a speed, so what it tells of a still car is that car's usual one."""
    heard, silent = (_told(vibration) for vibration in ([], ["dataset.chassis.vibration=0",
                                                             "dataset.chassis.vibration_rate=0"]))  # fmt: skip
    assert heard.error < 0.6 * silent.error and heard.std < 0.7 * silent.std
    assert 0.5 < heard.error / heard.std < 2.0


class _Told(NamedTuple):
    error: float  # m/s RMS over the last two minutes
    std: float  # m/s


def _told(words: list[str]) -> _Told:
    made_by = composed_recipe("simulated@dataset=lifelike", "seed=5", *words)
    batch = aligned_drives([drive_in_memory(made_by, 0, 300, torch.float64)])
    with torch.no_grad():
        speed = integrate(batch, trained_filter("plus")).speed[0, -120:]
    truth = (batch.truth.C_nb[0, :, :, 0] * batch.truth.v_n[0]).sum(-1)[-120:]
    return _Told(float((speed[:, 0] - truth).square().mean().sqrt()), float(speed[:, 1].square().mean().sqrt()))
