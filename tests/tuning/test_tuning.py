"""Over-bounding factors: what the objectives count, what a search finds, and what the command leaves behind."""

from __future__ import annotations

import json
import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from dlkf.base.console import warn_once
from dlkf.base.errors import InputError
from dlkf.data.masks import withhold_fixes
from dlkf.data.store import dataset_digest
from dlkf.evaluation.metrics import PVA
from dlkf.evaluation.outages import OutagePlan
from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.model_based import bias_sigma
from dlkf.filters.tuning import Prior, Tuning
from dlkf.onboard.library import find_compiler
from dlkf.tuning.baselines import tune_baselines
from dlkf.tuning.search import FACTORS, best_prior, evaluate_objective, list_factors, mean_imu_error, tune_filter
from dlkf.tuning.study import TuningResult, _count_compared, check_settings, train_test_drives, tuning_table
from tests.cars import IMU


def hidden(batch):
    return withhold_fixes(batch, OutagePlan(30.0, 20.0).masks(batch)[0])


def test_objectives_are_what_they_say(cars):
    batch = hidden(cars)
    solution = integrate(batch, build_filter("mbkf15", IMU))
    ends = (solution.posterior.p_n - batch.truth.p_n)[:, 49, :2].norm(dim=-1)
    found = {o: evaluate_objective(build_filter("mbkf15", IMU), [batch], o) for o in ("rms", "median", "log")}
    assert found["rms"] == pytest.approx(float(ends.square().mean().sqrt()))
    assert found["median"] == pytest.approx(float(ends.quantile(0.5)))
    assert found["log"] == pytest.approx(float(ends.log().mean().exp()))


def test_pva_is_the_geometric_mean_of_what_the_papers_tables_score(cars):
    """RMS of position, velocity and attitude over each segment, with GNSS throughout."""
    state, truth = integrate(cars, build_filter("mbkf15", IMU)).posterior, cars.truth
    turn = state.C_nb @ truth.C_nb.mT
    angle = torch.arccos(((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    sizes = torch.stack([(state.p_n - truth.p_n).norm(dim=-1), (state.v_n - truth.v_n).norm(dim=-1), angle])
    expected = sizes.square().mean(-1).sqrt().log().mean().exp()
    assert evaluate_objective(build_filter("mbkf15", IMU), [cars], PVA) == pytest.approx(float(expected), rel=1e-4)


@pytest.mark.commands
def test_a_filter_tuned_for_gnss_throughout_beats_one_tuned_for_outages_there(cars):
    batches = {"log": [hidden(cars)], PVA: [cars]}
    tuned = {o: tune_filter(IMU, b, rounds=1, objective=o)[0] for o, b in batches.items()}
    assert tuned["log"] != tuned[PVA]
    for objective, other in (("log", PVA), (PVA, "log")):
        best, worse = (
            evaluate_objective(build_filter("mbkf15", IMU, tuning=tuned[o]), batches[objective], objective)
            for o in (objective, other)
        )
        assert best < worse


def test_one_lost_segment_decides_rms_but_not_the_median(cars):
    batch = hidden(cars)
    imu = batch.imu.clone()
    imu[0, 30:] += torch.tensor([2.0, 2.0, 0, 0, 0, 0.1])
    lost = replace(batch, imu=imu)
    filters = build_filter("mbkf15", IMU)
    before, after = ([evaluate_objective(filters, [b], o) for o in ("rms", "median")] for b in (batch, lost))
    assert after[0] > 10 * before[0]
    assert after[1] < 2 * before[1]


def test_a_search_mends_noise_that_is_told_too_small(cars):
    small = replace(IMU, accel=replace(IMU.accel, noise_density=1e-5), gyro=replace(IMU.gyro, noise_density=1e-6))
    factors = {"accel_noise": (1.0, 100.0), "gyro_noise": (1.0, 100.0)}
    best, score, trials = tune_filter(small, [hidden(cars)], factors=factors, rounds=1)
    assert (best.accel_noise, best.gyro_noise) != (1.0, 1.0)
    assert score == min(t.score for t in trials) < evaluate_objective(build_filter("mbkf15", small), [hidden(cars)])


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
@pytest.mark.whole
def test_a_search_in_c_finds_what_one_in_torch_finds(cars, monkeypatch):
    """Every trial, though C takes sums in another order."""
    factors = {"accel_noise": (3.0, 10.0), "velocity_std": (2.0,), "lateral_std": (0.1,)}
    found = []
    for least in (10**9, 1):  # torch, C
        monkeypatch.setattr("dlkf.tuning.search.IN_C", least)
        best, score, trials = tune_filter(IMU, [hidden(cars)], name="mbkf15_nhc", factors=factors, rounds=1)
        found.append((best, score, [t.score for t in trials]))
    (best, score, scores), (best_c, score_c, scores_c) = found
    assert best == best_c and len(set(scores)) == len(scores)
    assert [score_c, *scores_c] == pytest.approx([score, *scores], rel=1e-9)
    assert scores_c != scores  # it was C


@pytest.mark.parametrize("wrong", ["no compiler", "a compiler that fails", "a cache that cannot be written"])
def test_a_search_that_cannot_run_in_c_says_so_once(wrong, cars, monkeypatch, tmp_path, capfd):
    """And finds in torch what it finds."""
    cc, cache = tmp_path / "cc", tmp_path / "cache"
    if wrong == "a compiler that fails":
        cc.write_text("#!/bin/sh\nexit 1\n")
        cc.chmod(0o755)
    elif wrong == "a cache that cannot be written":
        cache.write_text("a file where a folder should be")
    if wrong != "a cache that cannot be written":
        monkeypatch.setenv("PATH", str(tmp_path))
        monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setattr("dlkf.tuning.search.IN_C", 1)
    warn_once.cache_clear()
    for _ in range(1 if wrong == "a compiler that fails" else 2):  # that one takes seconds to find out
        tune_filter(IMU, [hidden(cars)], factors={"accel_noise": (3.0,)}, rounds=1)
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("dlkf: warning: ")]
    assert len(lines) == 1 and "trials run in torch, some 3 × slower: " in lines[0]
    assert {"no compiler": "install one", "a compiler that fails": "it ended with 1"}.get(wrong, str(cache)) in lines[0]


def test_every_filter_has_the_factors_that_it_uses():
    assert list_factors("mbkf15") == dict(FACTORS)
    assert set(list_factors("mbkf33_car_gated")) == {*FACTORS, "lateral_std", "vertical_std", "gate"}
    assert set(list_factors("aekf")) == {*FACTORS, "forgetting"}
    known = set(Tuning.__dataclass_fields__)
    for name in ("mbkf15_nhc", "mbkf21_car", "mbkf15_gated", "aekf"):
        assert set(list_factors(name)) <= known


def one_unit(batch):
    """All segments with the sensor matrices of one unit, 2 % of scale and misalignment, and an IMU that is told so."""
    M = torch.zeros(2, 3, 3, dtype=torch.float64)
    M[0, 0, 0], M[0, 1, 0], M[1, 2, 2] = 0.02, 0.02, -0.02
    forces, rates = (batch.imu[..., :3] @ M[0].mT, batch.imu[..., 3:] @ M[1].mT)
    wide = {"scale_factor": 0.02, "misalignment": 0.02}
    expected = replace(IMU, accel=replace(IMU.accel, **wide), gyro=replace(IMU.gyro, **wide))
    return replace(batch, imu=batch.imu + torch.cat((forces, rates), -1)), expected, M


def test_many_segments_together_show_the_sensor_matrices_of_their_unit(cars):
    batch, expected, M = one_unit(cars)
    prior = mean_imu_error(expected, Tuning(), [hidden(batch)], "mbkf33")
    assert len(prior.mean) == len(prior.std) == 24
    states = build_filter("mbkf33", expected).states
    of = {(s, e): 6 + 9 * s + k for s in range(2) for k, e in enumerate(states.elements)}
    for place in ((0, (0, 0)), (0, (1, 1)), (1, (2, 2))):  # what speeding up and turning show
        mean, std = (x[of[place]] for x in (prior.mean, prior.std))
        assert std < 0.004 and abs(mean - float(M[place[0]][place[1]])) < 4 * std
    assert prior.std[of[1, (2, 0)]] > 0.015  # a car that does not roll shows nothing of this one


@pytest.mark.parametrize("name", ["mbkf15", pytest.param("mbkf33", marks=pytest.mark.commands)])
def test_a_prior_of_one_segment_is_as_wide_as_the_turn_on_bias(cars, name):
    """One estimate has no scatter; NaN instead would make every filter with it diverge."""
    batch, expected, _ = one_unit(cars)
    one = batch.select(torch.tensor([0]))
    prior = mean_imu_error(expected, Tuning(), [one], name)
    assert np.isfinite(prior.mean).all() and np.isfinite(prior.std).all()
    assert np.allclose(prior.std[:6], bias_sigma(expected, build_filter(name, expected).states), rtol=1e-6)
    name = f"{name}_prior+receiver"  # what stands behind a plus is kept, the prior left out
    best, _ = best_prior(expected, [Tuning()], [hidden(one)], name)
    assert math.isfinite(evaluate_objective(build_filter(name, expected, prior=best), [hidden(one)]))


def test_a_filter_that_is_told_its_unit_drifts_less(cars):
    batch, expected, _ = one_unit(cars)
    found = tune_baselines(["mbkf15_prior", "mbkf33", "mbkf33_prior"], expected, [hidden(batch)], rounds=0, say=str)
    assert len(found.priors["mbkf15_prior"].mean) == 6 and len(found.priors["mbkf33_prior"].mean) == 24
    expected, untold = (evaluate_objective(found.build()[n], [hidden(batch)]) for n in ("mbkf33_prior", "mbkf33"))
    assert expected < 0.8 * untold


@pytest.mark.commands
def test_the_best_prior_is_the_best_of_all_that_were_tried(cars, monkeypatch):
    """Of factors and spreads, for biases and sensor matrices apart, with the means of longer segments."""
    monkeypatch.setattr("dlkf.tuning.search.BIAS_SPREADS", (3.0, 0.3))
    monkeypatch.setattr("dlkf.tuning.search.MATRIX_SPREADS", (10.0, 1.0))
    batch, expected, _ = one_unit(cars)
    tunings, name = [Tuning(), Tuning(accel_noise=30.0, gyro_noise=30.0)], "mbkf33_prior"
    steps = []
    monkeypatch.setattr("dlkf.tuning.search.show_progress", lambda _: nullcontext(lambda *step: steps.append(step)))
    prior, tuning = best_prior(expected, tunings, [hidden(batch)], name, longer=[batch])
    known = [mean_imu_error(expected, t, [batch], "mbkf33") for t in tunings]
    trials = [(p.scale_spread(b, m), t) for p in known for b in (3.0, 0.3) for m in (10.0, 1.0) for t in tunings]
    tried = {
        (p, t): evaluate_objective(build_filter(name, expected, tuning=t, prior=p), [hidden(batch)]) for p, t in trials
    }
    assert (prior, tuning) == min(tried, key=tried.__getitem__)
    assert len(set(tried.values())) == 16 and steps == [(k, 16) for k in range(1, 17)]


def test_spreads_of_biases_and_matrices_scale_apart():
    prior = Prior(tuple(range(24)), (1.0,) * 24).scale_spread(3.0, 0.5)
    assert prior.mean == tuple(range(24)) and prior.std == (3.0,) * 6 + (0.5,) * 18


def test_untuned_baselines_keep_the_factors_that_they_begin_with(cars):
    coarse = Tuning(position_std=25.0, velocity_std=2.5)
    found = tune_baselines(["ins", "mbkf15", "mbkf21"], IMU, [hidden(cars)], rounds=0, say=str, start=coarse)
    assert found.tunings == {"ins": Tuning(), "mbkf15": coarse, "mbkf21": coarse}


@pytest.mark.parametrize("model, objective", [("ins", "rms"), ("mbkf15_prior", "likelihood"), ("no_such", "rms")])
def test_what_has_no_noise_of_its_own_is_refused(model, objective):
    with pytest.raises(InputError, match=f"model={model}"):
        check_settings(model, objective)


def test_the_command_writes_factors_that_evaluate_takes(uri, call, town):
    size = ("length_s=50", "outage.first_s=25", "outage.duration_s=20", "fractions=[0.5,0,0.5]", "rounds=1")
    done = call("tune", "model=mbkf15", f"dataset={town}", "imu=perfect", "name=cars", "out=found", *size)
    assert done.code == 0, done.err
    factors = yaml.safe_load(Path("found/tuning/cars.yaml").read_text())
    fitted_on = factors.pop("fitted_on")
    assert Tuning(**factors) != Tuning()  # a perfect IMU's noise is too small here
    assert fitted_on["recordings"] == ["g1", "g2"] and fitted_on["digest"] == dataset_digest(town)
    assert "train" in done.out and "test" in done.out and Path("mlflow.db").is_file()
    cut = ("length_s=50", "outage.first_s=25", "outage.duration_s=20", "injected_bias=null")
    done = call("evaluate", "--config-dir", "found", "tuning=cars", "model=mbkf15", f"dataset={town}", "out=seen", *cut)
    assert done.code == 0, done.err
    fitted = "the tuning of mbkf15 was fitted on 2 of these 3 recordings, so its errors are too small"
    assert f"{fitted}; unseen=true leaves them out" in " ".join(done.out.split())
    unseen = ("model=mbkf15", f"dataset={town}", "out=unseen", "unseen=true")
    done = call("evaluate", "--config-dir", "found", "tuning=cars", *unseen, *cut)
    assert done.code == 0 and "was fitted" not in done.out, done.err
    content = json.loads(Path("unseen/metrics.json").read_text())
    assert content["results"][0]["count"]["groups"] == 1 and "fitted_on" not in content["protocol"]["tuning"]
    done = call("tune", "model=mbkf15", f"dataset={town}", "out=none", *size[:1], "outage.first_s=45", *size[2:])
    assert done.code == 2 and not Path("none").exists(), done.err


@pytest.mark.commands
def test_the_command_tunes_for_gnss_throughout(uri, call, town):
    common = ("tune", "model=mbkf15", f"dataset={town}", "imu=perfect", "length_s=50", "outage=null", "rounds=1")
    done = call(*common, "fractions=[0.5,0,0.5]", "objective=pva", "name=cars", "out=found")
    assert done.code == 0, done.err
    assert set(json.loads(Path("found/errors.json").read_text())) == {
        f"{side}/pva/{when}" for side in ("train", "test") for when in ("untuned", "tuned")
    }
    prior = ("prior.mean=[0,0,0,0,0,0]", "prior.std=[1e-3,1e-3,1e-3,1e-5,1e-5,1e-5]")
    of_prior = ("tune", "model=mbkf15_prior", *common[2:], "fractions=[0.5,0,0.5]", "objective=pva", "name=cars")
    done = call(*of_prior, *prior, "out=known")
    assert done.code == 0, done.err
    tuned = [Path(f"{out}/tuning/cars.yaml").read_text() for out in ("found", "known")]
    assert tuned[0] != tuned[1]
    done = call(*of_prior, "out=none")
    assert done.code == 2 and "prior.mean" in done.err and not Path("none").exists()
    done = call(*common, "objective=log", "out=none")
    assert done.code == 2 and "give objective=pva" in done.err and not Path("none").exists()


def test_a_split_that_cuts_drives_is_refused():
    """Segments of one drive on both sides: what is tuned on would be tested on."""
    with pytest.raises(InputError, match="split=group"):
        train_test_drives([], "random", (0.7, 0.15, 0.15), 0, 60.0)


def test_the_table_says_of_how_many_outages_it_is(cars):
    """Whole drives: two outages in each, or none."""
    masks = OutagePlan(30.0, 5.0).masks(cars)[0] | OutagePlan(50.0, 5.0).masks(cars)[0]
    assert _count_compared([withhold_fixes(cars, masks), cars], True) == (2 * len(masks), len(set(cars.drive)))
    assert _count_compared([cars], False) == (len(masks), len(set(cars.drive)))
    errors = (("train", "rms", 2.0, 1.0), ("test", "rms", 2.0, 1.0))
    compared = {"train": (60, 7), "test": (1, 1)}
    table = tuning_table(TuningResult("mbkf21", Tuning(), Tuning(), (), errors, (), compared), "town")
    assert "train: 60 outages of 7 drives. test: 1 outage of 1 drive, too few to conclude from." in table.note
