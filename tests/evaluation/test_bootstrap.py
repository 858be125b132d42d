"""Paired bootstrap: coverage, pairing, groups, and what is not finite."""

import math

import numpy as np
import pytest
from scipy.stats import gmean, norm, t

from dlkf.evaluation.bootstrap import compare, draw_weights, levels, rms_band, weighted_means


def test_weighted_statistics_equal_those_of_the_repeated_values():
    rng = np.random.default_rng(0)
    x = rng.normal(size=31) ** 2
    w = rng.integers(0, 4, size=(5, 31)).astype(float)
    for row, got in zip(w, zip(*(weighted_means(x, w, s) for s in ("rms", "mean", "median", "geomean")))):
        drawn = np.repeat(x, row.astype(int))
        assert np.allclose(got, (np.sqrt(np.mean(drawn**2)), drawn.mean(), np.median(drawn), gmean(drawn)))


def test_same_seed_same_interval_and_blocks_do_not_matter(monkeypatch):
    a, b = np.random.default_rng(1).normal(size=(2, 50)) ** 2
    whole = compare(a, b, resamples=300, seed=7)
    assert whole == compare(a, b, resamples=300, seed=7) != compare(a, b, resamples=300, seed=8)
    monkeypatch.setattr("dlkf.evaluation.bootstrap._CELLS", 999)
    blocks = compare(a, b, resamples=300, seed=7)  # products of other shapes: the last bit may differ
    of_blocks, of_whole = ({k: x for k, x in vars(c).items() if not isinstance(x, str)} for c in (blocks, whole))
    assert blocks.statistic == whole.statistic and of_blocks == pytest.approx(of_whole, rel=1e-12)


def test_interval_covers_the_true_ratio_about_as_often_as_it_says():
    """200 experiments of 60 pairs with true RMS ratio 0.7: 95 % nominal, binomial 3σ is 4.6 points."""
    rng = np.random.default_rng(3)
    hits = 0
    for k in range(200):
        hard = np.exp(0.3 * rng.normal(size=60))  # segments differ in difficulty, for both filters alike
        a, b = 0.7 * hard * np.abs(rng.normal(size=60)), hard * np.abs(rng.normal(size=60))
        c = compare(a, b, resamples=400, seed=k)
        hits += c.ratio_low <= 0.7 <= c.ratio_high
    assert 0.88 <= hits / 200 <= 0.99


@pytest.mark.parametrize(("recordings", "segments"), [(8, 5), (19, 7)])
def test_interval_of_few_recordings_covers_what_it_says(recordings, segments):
    """Log-normal errors of two equal filters: spread 0.6 shared and 0.4 each between recordings, 0.5 within.

    Recordings differ in length by up to a factor of six. 300 experiments tell coverage to 1.3 points (1σ at 95 %).
    The RMS of so skewed errors is biased with few recordings, so 90 % is all that is asked of its interval.
    """
    rng, hits, count = np.random.default_rng(recordings), {"rms": 0, "geomean": 0, "median": 0}, 300
    for k in range(count):
        g = np.repeat(np.arange(recordings), rng.integers(max(1, segments // 3), 2 * segments + 1, recordings))
        shared = 0.6 * rng.normal(size=recordings)
        a, b = (
            np.exp((shared + 0.4 * rng.normal(size=recordings))[g] + 0.5 * rng.normal(size=len(g))) for _ in range(2)
        )
        for statistic in hits:
            c = compare(a, b, statistic=statistic, groups=g, resamples=400, seed=k)
            hits[statistic] += c.ratio_low <= 1 <= c.ratio_high
    covered = {s: n / count for s, n in hits.items()}
    assert 0.90 <= covered["rms"] <= 0.99, covered
    assert 0.92 <= covered["geomean"] <= 0.99 and 0.92 <= covered["median"] <= 0.99, covered


def test_rms_of_much_more_skewed_errors_is_told_too_small_and_their_geometric_mean_is_not():
    """RMS over median 6 against 2, as of a filter with constraints against one without: known, and said so.

    200 experiments tell coverage to 3 points (1σ at 76 %), 1.5 points (at 95 %).
    """
    rng, skews, count = np.random.default_rng(41), np.array([1.35, 0.88]), 200
    rms, above, geomean = 0, 0, 0
    for k in range(count):
        g = np.repeat(np.arange(41), rng.integers(2, 15, 41))
        shared, own = rng.normal(size=(2, 41)), rng.normal(size=(2, len(g)))
        shared[1], own[1] = ((x[0] + 3**0.5 * x[1]) / 2 for x in (shared, own))
        a, b = np.exp(skews[:, None] * (0.3**0.5 * shared[:, g] + 0.7**0.5 * own))
        c = compare(a, b, groups=g, resamples=300, seed=k)
        true = math.exp(skews[0] ** 2 - skews[1] ** 2)
        rms, above = rms + (c.ratio_low <= true <= c.ratio_high), above + (true > c.ratio_high)
        c = compare(a, b, statistic="geomean", groups=g, resamples=300, seed=k)
        geomean += c.ratio_low <= 1 <= c.ratio_high
    assert 0.65 <= rms / count <= 0.87 and above / count > 0.1
    assert 0.90 <= geomean / count <= 0.99


def test_levels_are_those_of_students_t():
    low, high = levels(8)
    assert low + high == pytest.approx(100) and norm.ppf(high / 100) == pytest.approx(t.ppf(0.975, 7) * (8 / 7) ** 0.5)
    assert levels(10**6) == pytest.approx((2.5, 97.5), abs=1e-3)


def test_pairing_takes_the_difficulty_of_segments_out_of_the_interval():
    rng = np.random.default_rng(4)
    hard = np.exp(rng.normal(size=80))
    paired = compare(0.8 * hard, hard, seed=1)
    assert paired.ratio == pytest.approx(0.8) and paired.ratio_high - paired.ratio_low < 1e-9
    shuffled = compare(0.8 * hard, rng.permutation(hard), seed=1)
    assert shuffled.ratio_high - shuffled.ratio_low > 0.2


def test_outages_of_one_drive_are_drawn_together():
    rng = np.random.default_rng(5)
    level = np.repeat(np.exp(0.5 * rng.normal(size=12)), 20)  # 12 drives of 20 like outages each
    a, b = level * (1 + 0.01 * rng.normal(size=240)), np.ones(240)
    groups = np.repeat([f"d{i}" for i in range(12)], 20)
    alone, together = compare(a, b, seed=2), compare(a, b, groups=groups, seed=2)
    assert together.groups == 12 and alone.groups == 240
    ratio = (together.ratio_high - together.ratio_low) / (alone.ratio_high - alone.ratio_low)
    assert 0.6 * math.sqrt(20) < ratio < 1.4 * math.sqrt(20)  # effective sample 240 against 12
    few = compare(a, b, groups=np.repeat(["x", "y"], 120), seed=2)
    assert few.groups == 2 and few.ratio > 0 and math.isnan(few.ratio_low)  # two recordings make no interval
    assert math.isnan(compare(a[:7], b[:7], seed=2).ratio_high) and compare(a[:8], b[:8], seed=2).ratio_high > 0


def test_missing_truth_is_left_out_of_both_and_a_broken_filter_stays():
    a, b = np.array([1.0, np.nan, 3.0, 4.0]), np.array([2.0, 5.0, np.nan, 8.0])
    c = compare(a, b, seed=0)
    assert c.units == 2 and c.ratio == pytest.approx(0.5)
    broken = compare(np.array([1.0, np.inf, *[1.0] * 6]), np.ones(8), seed=0)
    assert broken.ratio == math.inf and broken.ratio_high == math.inf and broken.ratio_low == 1.0
    none = compare(np.full(3, np.nan), np.ones(3))
    assert none.units == 0 and math.isnan(none.ratio) and math.isnan(none.ratio_low)


def test_weights_draw_every_group_as_often_on_average():
    groups = np.array([0, 0, 1, 2, 2, 2, 3])
    w = np.concatenate(list(draw_weights(groups, 4000, np.random.default_rng(0))))
    assert np.array_equal(w[:, 0], w[:, 1]) and (w[:, [0, 2, 3, 6]].sum(-1) == 4).all()
    assert np.allclose(w.mean(0), 1.0, atol=0.06)  # σ of the mean of 4000 draws is 0.014


def test_band_is_as_wide_as_theory_says_and_gaps_are_gaps():
    x = np.random.default_rng(6).normal(size=(400, 3))
    x[:, 2] = np.nan
    rms, low, high = rms_band(x, resamples=1000)
    # RMS of n unit normals has σ = 1/√(2n): the 95 % band is 2·1.96/√800 = 0.139 wide
    assert rms[:2] == pytest.approx([1, 1], abs=0.12) and high[:2] - low[:2] == pytest.approx([0.139] * 2, rel=0.2)
    assert np.isnan([rms[2], low[2], high[2]]).all()
    few, narrow, wide = rms_band(x[:, :2], groups=["a"] * 200 + ["b"] * 200, resamples=50)
    assert few[0] == rms[0] and np.isnan([narrow, wide]).all()
    x[3, 0] = np.inf
    rms, low, high = rms_band(x, resamples=50)
    assert rms[0] == np.inf and np.isnan(low[0]) and np.isfinite(low[1])
