"""A source of measurements of one's own, that of docs/developing.md; smoothed filters; factors on fixes."""

import re
import sys
from dataclasses import replace

import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.filters.build import FilterName, build_filter, is_filter, refuse_smoothed
from dlkf.filters.gating import Gate
from dlkf.filters.integration import integrate
from dlkf.filters.noise_factors import NoiseFactors
from dlkf.filters.smoother import SmoothedSolution
from dlkf.running.noise_fit import check_finds_noise
from tests.docs.pages import ROOT, blocks

from .scene import IMU, scene


@pytest.fixture
def on_path(tmp_path, monkeypatch):
    (example,) = (block for block in blocks(ROOT / "docs" / "developing.md") if block.file == "speed_limit.py")
    (tmp_path / "speed_limit.py").write_text(example.text)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("speed_limit", None)


def test_a_source_of_one_s_own_is_heard(on_path):
    """Cars of 12 m/s told that 10 is the limit: slower in the outage, the same filter otherwise."""
    name = "mbkf21_nhc+speed_limit:SpeedLimit"
    batch = scene(3, 30)
    batch.available[:, 15:] = False
    assert is_filter(name)
    with torch.no_grad():
        expected, plain = (integrate(batch, build_filter(n, IMU)) for n in (name, "mbkf21_nhc"))
    over = [(s.posterior.v_n[:, 15:, :2].norm(dim=-1) - 10.0).clamp_min(0).sum() for s in (expected, plain)]
    assert over[0] < 0.9 * over[1]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mbkf21+nowhere:Source", "No module named 'nowhere'"),
        ("mbkf21+math:sources", "is a part of Python"),
        ("mbkf21+math:sqrt", "is a part of Python"),
        ("mbkf21+math", "unknown model"),
    ],
)
def test_what_is_no_source_is_told(name, words):
    with pytest.raises(InputError, match=re.escape(words)):
        build_filter(name, IMU)


def test_a_smoothed_filter_is_no_estimator():
    built = build_filter("mbkf21_rts", IMU)
    assert isinstance(built, SmoothedSolution) and not hasattr(built, "step")
    with pytest.raises(InputError, match="take mbkf21_nhc"):
        refuse_smoothed("mbkf21_nhc_rts", "a stream cannot")


def test_the_gate_s_limits_are_computed_once(monkeypatch):
    calls = []
    monkeypatch.setattr("dlkf.filters.gating.chi2_quantile", lambda p, n: calls.append(n) or 1e9)
    with torch.no_grad():
        integrate(scene(2, 5), build_filter("mbkf15_gated", IMU))
    assert calls == [1, 2] and isinstance(build_filter("mbkf15_gated", IMU).fix.gate, Gate)


def test_what_needs_a_causal_filter_refuses_a_smoothed_one_in_one_line():
    from dlkf.running.streaming import StreamingFilter
    from dlkf.tuning.study import check_settings

    with pytest.raises(InputError, match="which a stream cannot"):
        StreamingFilter(build_filter("mbkf21_rts", IMU))
    for name in ("mbkf21_rts", "mbkf21_rts+speed"):
        with pytest.raises(InputError, match="tune it without _rts"):
            check_settings(name, "log")


def test_a_name_is_taken_apart_and_put_together():
    for name in ("ins", "mbkf33_prior_gated+vibration_speed+receiver", "mbkf21_nhc+my_sources:SpeedLimit"):
        assert str(FilterName.parse(name)) == name
    prior = FilterName.parse("mbkf33_car_prior+vibration_speed")
    assert prior.drop("prior") == "mbkf33_car+vibration_speed" == str(prior._replace(endings=("car",)))
    assert FilterName.parse("mbkf21_nhc+speed").add(["speed", "baro"]) == "mbkf21_nhc+speed+baro"
    assert FilterName.parse("mbkf21+speed").add(["baro"]) == "mbkf21+speed"  # knows no car
    with pytest.raises(InputError, match="imu=auto estimates the noise of Kalman filters"):
        check_finds_noise("mbkf15_prior+speed")


class Advised:
    """A Kalman filter that is told factors on the stds of every fix: horizontal and down, position then velocity."""

    def __init__(self, kalman, factors):
        self.kalman, self.factors = kalman, torch.tensor([factors], dtype=torch.float64)

    def begin(self, batch):
        return self.kalman.begin(batch)

    def step(self, memory, epoch):
        noise = NoiseFactors(fix=self.factors.expand(len(epoch.z), 4))
        return self.kalman.step(memory, epoch._replace(noise=noise))


def test_advice_on_a_fix_is_a_factor_on_its_std():
    """The same solution as of fixes that claim so much themselves."""
    batch, kalman = scene(2, 20), build_filter("mbkf15", IMU)
    claimed = batch.gnss_std * torch.tensor([2.0, 2.0, 0.5, 3.0, 3.0, 0.7], dtype=torch.float64)
    with torch.no_grad():
        expected = integrate(batch, Advised(kalman, [2.0, 0.5, 3.0, 0.7]))
        same = integrate(replace(batch, gnss_std=claimed), kalman)
        plain = integrate(batch, kalman)
    torch.testing.assert_close(expected.posterior.p_n, same.posterior.p_n, rtol=0, atol=1e-9)
    assert (expected.posterior.p_n - plain.posterior.p_n).abs().max() > 1e-3
