"""Gains: those of the last fix, their mean and spread, and the trend of paper 5.2 for a Kalman filter."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import torch

from dlkf.evaluation.gains import measure_gains, write_gains
from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from tests.filters.scene import IMU, scene


def degraded(position_std: float, velocity_std: float):
    batch = scene(4, 40, seed=2, position_std=position_std, velocity_std=velocity_std)
    return batch, torch.zeros(batch.size[:2], dtype=torch.bool)


def test_gains_are_those_of_the_filter():
    batch, mask = degraded(0.05, 0.05)
    batch = replace(batch, available=batch.available & (torch.arange(40) < 35))  # the last fix is the 35th
    filters = {"mbkf15": build_filter("mbkf15", IMU), "ins": build_filter("ins", IMU)}
    found = measure_gains(filters, [(batch, mask)], settle_s=10.0)
    assert list(found) == ["mbkf15"]
    gain = integrate(batch, filters["mbkf15"]).gain.numpy()
    assert np.allclose(found["mbkf15"].last, gain[:, 34], rtol=1e-9, atol=1e-12)  # compiled against tensors: rounding
    assert np.allclose(found["mbkf15"].mean, gain[:, 10:35].mean((0, 1)))
    assert np.allclose(found["mbkf15"].std, gain[:, 10:35].std((0, 1)))


def test_the_gain_follows_the_noise_of_gnss():
    """R134, R135: K_pp falls with s_p while velocity takes over, K_vv with s_v while position does."""
    at = {}
    for s_p, s_v in ((0.03, 0.02), (1.0, 0.02), (5.0, 0.02), (0.03, 0.5), (0.03, 2.0)):
        at[s_p, s_v] = measure_gains({"mbkf15": build_filter("mbkf15", IMU)}, [degraded(s_p, s_v)])["mbkf15"]
    falls = [at[s_p, 0.02].block("K_pp") for s_p in (0.03, 1.0, 5.0)]
    assert falls == sorted(falls, reverse=True) and falls[0] > 10 * falls[2]
    assert at[5.0, 0.02].block("K_pv") > at[0.03, 0.02].block("K_pv")
    falls = [at[0.03, s_v].block("K_vv") for s_v in (0.02, 0.5, 2.0)]
    assert falls == sorted(falls, reverse=True) and falls[0] > 10 * falls[2]
    assert at[0.03, 2.0].block("K_vp") > at[0.03, 0.02].block("K_vp")


def test_files_hold_what_figures_and_tables_need(tmp_path):
    found = measure_gains({"mbkf15": build_filter("mbkf15", IMU)}, [degraded(0.05, 0.05)])
    write_gains(tmp_path, found, "town")
    values = json.loads((tmp_path / "gains.json").read_text())["mbkf15"]
    assert np.array_equal(values["last"], found["mbkf15"].last[0]) and values["K_pp"] == found["mbkf15"].block("K_pp")
    assert (tmp_path / "figures" / "gains.png").read_bytes().startswith(b"\x89PNG")
