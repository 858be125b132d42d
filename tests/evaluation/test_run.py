"""Scoring through the real filter loop: chunks, precision, masks, order, and the slope of a Kalman filter."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.data.masks import BiasLaw
from dlkf.evaluation.metrics import magnitudes, rms_over_segments, slope
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.study import choose_baseline, inject_bias
from dlkf.filters.build import build_filter
from dlkf.filters.integration import Correction
from dlkf.filters.model_based import Ins
from dlkf.running.batched import chunks
from tests.cars import IMU
from tests.evaluation.scoring import score

FILTERS = {name: build_filter(name, IMU) for name in ("ins", "mbkf15")}


@pytest.mark.parametrize(
    ("named", "models", "chosen"),
    [
        (None, ["ins", "mbkf15", "plus"], "mbkf15"),
        (None, ["mbkf21_car", "plus"], "mbkf21_car"),
        ("plus", ["mbkf15", "plus"], "plus"),
        ("mbkf15", ["mbkf21_car", "plus"], "mbkf15"),  # a filter that is not among them: no ratios, which is said
    ],
)
def test_the_baseline_is_the_one_named_or_the_usual_or_the_first(named, models, chosen):
    assert choose_baseline(named, models) == chosen


def _ragged(batch):
    present = batch.present.clone()
    for i, n in enumerate((60, 31, 45, 60, 12, 50)):
        present[i, n:] = False
    return replace(batch, present=present)


def test_chunked_equals_whole_with_segments_of_different_length(cars):
    batch = _ragged(cars)
    seen = []
    whole = score(FILTERS, [batch], kinds="real")
    parts = score(FILTERS, [batch], kinds="real", chunk_samples=2500, progress=lambda *a: seen.append(a))
    for name in FILTERS:
        for field in ("error", "p_n", "imu_error", "imu_std"):
            a, b = getattr(whole.filters[name], field), getattr(parts.filters[name], field)
            assert np.allclose(a, b, rtol=1e-9, atol=1e-9, equal_nan=True), field  # batched matmul rounding
    assert np.isnan(whole.filters["ins"].error[4, 12:]).all() and np.isfinite(whole.filters["ins"].error[4, :12]).all()
    assert len(seen) > 2 * len(FILTERS) and seen[-1] == (12, 12)


def test_chunks_cover_every_segment_once_and_drop_the_padding(cars):
    batch = _ragged(cars)
    found = list(chunks(batch, 2500))
    assert sorted(i for c in found for i in c.tolist()) == list(range(6))
    shortest = batch.select(found[-1]).trim()
    assert shortest.size[1] == int(batch.present[found[-1]].sum(-1).max())
    assert shortest.drive == tuple(batch.drive[i] for i in found[-1])
    assert torch.equal(shortest.frame.origin_e, batch.frame.origin_e[found[-1]])


def test_outage_errors_grow_until_gnss_is_back(cars):
    (mask,) = OutagePlan(first_s=30, duration_s=20).masks(cars)
    scores = score(FILTERS, [cars], outages=[mask])
    rms = rms_over_segments(magnitudes(scores.filters["mbkf15"].error)["horizontal"])
    assert (np.diff(rms[32:50]) > 0).all() and rms[49] > 10 * rms[29] and rms[50] < 0.1 * rms[49]
    free = score(FILTERS, [cars])
    inside = free.filters["mbkf15"].error[:, 49]
    assert np.abs(inside[:, :3]).max() < 0.2  # the same epochs with GNSS: centimetres
    strapdown, nothing = {"free": Ins(free=True)}, torch.zeros_like(mask)
    never, masked = (score(strapdown, [cars], outages=[m]).filters["free"].error for m in (nothing, mask))
    assert np.array_equal(never, masked), "strapdown from the start knows no GNSS"


def test_ins_runs_free_from_the_last_fix_not_from_the_start(cars):
    """Position and velocity of the fix, attitude from the start: centimetres at the fix, a parabola from there."""
    (mask,) = OutagePlan(first_s=30, duration_s=20).masks(cars)
    scores = score({"ins": Ins(), "free": Ins(free=True)}, [cars], outages=[mask])
    size = {n: magnitudes(r.error)["horizontal"] for n, r in scores.filters.items()}
    assert np.abs(size["ins"][:, :30]).max() < 0.1  # 0.03 m is the fixes' 1σ per axis
    assert (size["ins"][:, 30] < 2).all() and (size["ins"][:, 49] > 10).all()
    assert (size["ins"][:, 30] < 0.1 * size["free"][:, 30]).all()


def test_several_batches_are_joined_and_named(cars):
    short = cars.select(torch.tensor([1, 2])).trim()
    short = replace(short, present=short.present.clone().index_fill_(1, torch.arange(40, 60), False))
    short = short.select(torch.tensor([0, 1])).trim()
    scores = score({"ins": FILTERS["ins"]}, [cars, short], groups={"car-01": "g"}, kinds={"car-01": "real"})
    assert len(scores.segments) == 8 and scores.filters["ins"].error.shape == (8, 60, 9)
    assert [p.group for p in scores.segments][-2:] == ["g", "car-02"]
    assert [p.kind for p in scores.segments][-2:] == ["real", "unknown"]
    assert np.isnan(scores.truth_p_n[6:, 40:]).all()
    one = scores.of_kind("real")
    assert len(one.segments) == 2 and one.filters["ins"].error.shape[0] == 2 and scores.kinds == ["real", "unknown"]


def test_a_network_is_scored_in_evaluation_mode_without_gradients(cars):
    seen = []

    class Probe(torch.nn.Module):
        def begin(self, batch):
            seen.append((self.training, torch.is_grad_enabled(), batch.imu.dtype))
            return None, batch.imu.new_zeros(batch.size[0], 6)

        def step(self, memory, epoch):
            return None, Correction(epoch.z.new_zeros(len(epoch.z), 9), epoch.imu_error)

    scores = score({"probe": Probe(), "ins": Ins(free=True)}, [cars])
    assert seen == [(False, False, torch.float64)]
    assert np.array_equal(scores.filters["probe"].error, scores.filters["ins"].error)


def test_float32_agrees_with_float64(cars):
    low = score({"mbkf15": FILTERS["mbkf15"]}, [cars.in_precision(torch.float32)])
    high = score({"mbkf15": FILTERS["mbkf15"]}, [cars])
    gap = np.abs(low.filters["mbkf15"].error - high.filters["mbkf15"].error)[:, 10:, :3]
    assert gap.max() < 0.02  # a third of the filter's own 3 cm


def test_a_kalman_filter_follows_an_injected_bias_and_pure_inertial_does_not(cars):
    base = score(FILTERS, [cars])
    no_outage = torch.zeros(cars.size[:2], dtype=torch.bool)
    inject_bias(base, FILTERS, [(cars, no_outage)], law=BiasLaw(0.03, 0.06), seed=4)
    slopes = {n: slope(run.bias_response, base.injected_bias, intercept=False) for n, run in base.filters.items()}
    assert np.allclose(slopes["ins"], 0.0)
    assert np.allclose(slopes["mbkf15"][[2, 3, 4]], 1.0, atol=0.05)  # down and level rates: always seen
    assert np.all(slopes["mbkf15"] > 0.5)  # level accelerations and yaw rate need turns


def test_nothing_to_score_and_unequal_epochs_are_refused(cars):
    with pytest.raises(InputError, match="nothing to score"):
        score({}, [cars])
    with pytest.raises(InputError, match="epoch"):
        score(FILTERS, [cars, replace(cars, dt=cars.dt * 2)])


def test_a_diverging_filter_shows_as_inf(cars):
    class Explodes:
        def begin(self, batch):
            return None, batch.imu.new_zeros(batch.size[0], 6)

        def step(self, memory, epoch):
            return None, Correction(epoch.z.new_full((len(epoch.z), 9), math.nan), epoch.imu_error)

    scores = score({"bad": Explodes()}, [cars])
    assert np.isinf(scores.filters["bad"].error).all()
