"""From a dataset to scenes, scores and solutions."""

import json
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pymap3d
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.base.parallel import parallel_map
from dlkf.base.settings import settings_from
from dlkf.data.datamodule import DriveDataModule
from dlkf.data.kinds import drive_kinds
from dlkf.data.masks import BiasLaw
from dlkf.data.segments import StartLaw
from dlkf.data.store import drive_rows, load_dataset
from dlkf.evaluation.chunks import EvaluationJob, evaluate_chunks
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.protocol import Protocol, Scenes, spread_evenly
from dlkf.evaluation.study import make_results, run_scenes
from dlkf.evaluation.table import all_tables
from dlkf.filters.build import build_filter
from dlkf.filters.smoother import SmoothedSolution
from dlkf.filters.tuning import Prior, Tuning
from dlkf.running.grid import UsableFixes
from dlkf.running.offline import (
    chunk_drives,
    load_chunk,
    navigate_chunks,
    navigate_dataset,
    navigate_drives,
)
from dlkf.tracking.models import resolve_model, resolve_models
from tests.cars import IMU

MBKF = build_filter("mbkf15", IMU)


@pytest.fixture(scope="module")
def drives(town):
    return load_dataset(town, rate_hz=20, dtype=torch.float64)


def test_segments_are_cut_where_truth_allows_and_outages_put_in(drives):
    protocol = Protocol(length_s=25, stride_s=25, outage=OutagePlan(first_s=10, duration_s=10), seed=1)
    scenes = Scenes(drives, protocol)
    (batch, mask), again = next(iter(scenes)), next(iter(scenes))
    assert scenes.mode == "segments" and scenes.runs == batch.size[0] == 12 and batch.size[1] == 25
    assert mask[:, 10:20].all() and mask.sum() == 12 * 10
    assert torch.equal(batch.start.p_n, again[0].start.p_n)  # iterating again is the same experiment
    other = next(iter(Scenes(drives, replace(protocol, seed=2))))[0]
    assert not torch.equal(batch.start.p_n, other.start.p_n)


def tables_of(folder, **settings):
    """Plain results of a filter over the test side of a data module, with drawn outages and injected biases."""
    size = {"length_s": 20.0, "eval_length_s": 25.0, "eval_stride_s": 5.0, "rate_hz": 20}
    data = DriveDataModule(folder, split={"train": ["g0"], "val": ["g1"], "test": ["g2"]}, **{**size, **settings})
    scenes = Scenes.of_split(data, "test", OutagePlan(first_s=(5, 10), duration_s=(5, 15)), seed=4)
    names = {"mbkf15": MBKF, "ins": build_filter("ins", IMU)}
    made = make_results(run_scenes(names, scenes, kinds="simulated", law=BiasLaw(0.05, 0.1), seed=4), seed=4)
    return json.dumps([r.as_dict() for r in made])


def test_the_test_is_the_same_for_every_batch_size_and_training_seed(town):
    """To the last bit: a comparison of trainings is one of trainings and not of tests."""
    one = tables_of(town, batch_size=10, seed=0)
    assert one == tables_of(town, batch_size=50, seed=1)
    assert one != tables_of(town, start=StartLaw(yaw_deg=1.0))
    first, second = (
        [b for k in (3, 50) for b in DriveDataModule(
            town, split={"train": ["g0"], "val": ["g1"], "test": ["g2"]}, eval_length_s=25.0, batch_size=k, seed=k
        ).batches(side)]
        for side in ("val", "test")
    )  # fmt: skip
    for batches in (first, second):
        alone, together = torch.cat([b.start.C_nb for b in batches[:-1]]), batches[-1].start.C_nb
        assert len(batches) == 3 and torch.equal(alone, together)


def test_start_errors_and_outages_do_not_know_the_imu_rate_nor_the_segments_beside(town):
    plan = OutagePlan(first_s=(5, 10), duration_s=(5, 15))
    law = Protocol(length_s=25, stride_s=25, outage=plan, seed=1)
    both = [load_dataset(town, rate_hz=rate, dtype=torch.float64) for rate in (10, 20)]
    (slow, mask), (fast, other) = (next(iter(Scenes(drives, law))) for drives in both)
    assert torch.equal(mask, other) and torch.equal(slow.start.p_n, fast.start.p_n)
    part, few = next(iter(Scenes(both[1][2:4][::-1], law)))
    where = [list(zip(fast.drive, fast.t_start)).index(segment) for segment in zip(part.drive, part.t_start)]
    assert torch.equal(few, other[where]) and torch.equal(part.start.v_n, fast.start.v_n[where])


def test_a_limit_keeps_segments_of_all_drives(drives):
    law = Protocol(length_s=10, stride_s=10)
    ((batch, _),) = Scenes(drives, law, limit=6)
    assert sorted(batch.drive) == sorted(d.name for d in drives)
    assert spread_evenly(range(10), 3) == [1, 5, 8] and spread_evenly(range(10), None) == list(
        range(10)
    ) == spread_evenly(range(10), 99)


def test_truth_without_attitude_means_whole_drives_from_their_own_alignment(drives):
    nothing = torch.full_like(drives[0].ref_C_eb, torch.nan)
    blind = [replace(d, ref_C_eb=nothing) for d in drives]
    scenes = Scenes(blind, Protocol(outage=OutagePlan(first_s=10, duration_s=10)))
    assert scenes.mode == "drives" and scenes.runs == 12 and scenes.outage.offsets_s == (0.0, 10.0)
    masks = torch.stack([mask for _, mask in scenes])
    t = torch.arange(1, masks.shape[-1] + 1)
    assert masks.any(0)[:, (t > 10) & (t <= 50)].all() and not masks.all(0).any()  # covered, once each
    (result,) = make_results(run_scenes({"mbkf15": MBKF}, scenes, kinds="real"))
    counted = {q: result.value("mbkf15", "segments", "all", q, "n") for q in ("attitude", "position")}
    assert counted == {"attitude": 0, "position": 12}
    assert result.value("mbkf15", "outages", "end", "horizontal") < 5
    assert len(all_tables("town", [result])) == 2


def test_study_reports_each_kind_apart_and_the_slope_of_an_injected_bias(drives):
    scenes = Scenes(drives, Protocol(length_s=50, stride_s=50))
    kinds = {d.name: "real" if i < 2 else "simulated" for i, d in enumerate(drives)}
    groups = {d.name: d.group for d in drives}
    bias = BiasLaw(accel_mps2=0.03, gyro_dps=0.06)
    made = make_results(run_scenes({"mbkf15": MBKF}, scenes, kinds=kinds, groups=groups, law=bias))
    assert [(r.kind, r.count["segments"]) for r in made] == [("real", 2), ("simulated", 4)]
    for r in made:
        for axis in ("accel_z", "gyro_x"):
            assert r.value("mbkf15", "segments", "last", axis, "injected_slope") == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"mode": "segment"}, "mode=segment"),
        ({"mode": "segments", "length_s": 500}, "no segment of 500 s"),
        ({"length_s": 40, "outage": {"first_s": 30, "duration_s": 20}}, "outage ends after 50 s"),
        ({"outage": {"start": 3}}, "unknown key start"),
        ({"length_s": -1}, "length_s"),
    ],
)
def test_impossible_protocols_are_refused(drives, settings, said):
    with pytest.raises(InputError, match=said):
        Scenes(drives, settings_from(Protocol, {"stride_s": 60, **settings}, ""))


def test_kinds_come_from_the_dataset(town):
    assert set(drive_kinds(town).values()) == {"simulated"}


def test_navigation_of_whole_drives_without_a_reference_folder(town, tmp_path, cars):
    shutil.copytree(town, tmp_path / "town")
    shutil.rmtree(tmp_path / "town" / "reference")
    drives = load_dataset(tmp_path / "town", rate_hz=20, dtype=torch.float64, reference=False)
    results = {r.drive: r for r in navigate_drives(drives, MBKF)}
    assert set(results) == set(cars.drive)
    for i, name in enumerate(cars.drive):
        table = results[name].table
        truth = pq.read_table(town / "reference" / f"drive={name}" / "part-0.parquet").to_pandas()
        both = table.merge(truth, on="t", suffixes=("", "_true"))
        assert len(both) == len(table) > 50
        north, east, down = pymap3d.geodetic2ned(
            *both[["lat_deg", "lon_deg", "height_m"]].to_numpy().T,
            *both[["lat_deg_true", "lon_deg_true", "height_m_true"]].to_numpy().T,
        )
        late = both.t > 130
        assert np.hypot(north, east)[late].max() < 0.2 and np.abs(down)[late].max() < 0.2  # cm GNSS
        turn = np.angle(np.exp(1j * (both.yaw - both.yaw_true)))
        assert np.abs(turn[late]).max() < np.radians(3)
        assert both.gnss_used.all() and np.isfinite(table.drop(columns="gnss_used")).all().all()
        bias = cars.true_imu_error[i, -1].numpy()
        assert abs(table.accel_error_z.iloc[-1] - bias[2]) < 5e-3  # the down axis is seen at once
    assert "fixes used" in results[cars.drive[0]].summary()


def test_the_reference_is_never_opened(town, tmp_path):
    """What lies in reference/ is unreadable, and nobody notices."""
    shutil.copytree(town, tmp_path / "town")
    for path in (tmp_path / "town" / "reference").rglob("*.parquet"):
        path.write_bytes(b"not Parquet")
    with pytest.raises(InputError):
        load_dataset(tmp_path / "town", rate_hz=20)
    drives = load_dataset(tmp_path / "town", rate_hz=20, dtype=torch.float64, reference=False)
    assert len(list(navigate_drives(drives[:1], MBKF))) == 1


def test_a_drive_that_cannot_be_aligned_is_named_or_left_out(drives):
    lost = replace(drives[0], gnss_valid=torch.zeros_like(drives[0].gnss_valid))
    with pytest.raises(InputError, match="car-00: no GNSS"):
        list(navigate_drives([lost, drives[1]], MBKF))
    skipped = {}
    assert [r.drive for r in navigate_drives([lost, drives[1]], MBKF, skipped=skipped)] == ["car-01"]
    assert "car-00" in skipped["car-00"]
    with pytest.raises(InputError, match="car-00"):
        list(navigate_drives([lost], MBKF, skipped={}))


def test_navigation_some_drives_at_a_time(town, tmp_path):
    """Drives loaded one after the other give what they give together; a share of which none starts is left out."""
    shutil.copytree(town, tmp_path / "town")
    rows = drive_rows(tmp_path / "town")
    fixes = {row.name: UsableFixes.of(tmp_path / "town", row.name) for row in rows}

    def shares(*samples, skip=False):
        run = partial(navigate_dataset, tmp_path / "town", MBKF, rate_hz=20.0, epoch_s=1.0)
        return parallel_map(partial(load_chunk, run, skip), chunk_drives(fixes, 20.0, *samples))

    assert chunk_drives(fixes, 20.0) == [tuple(row.name for row in rows)]
    together = {r.drive: r.table for r in navigate_chunks(shares(), len(rows))}
    seen, counted = {}, []
    for r in navigate_chunks(shares(1), len(rows), progress=lambda *k: counted.append(k)):
        seen[r.drive] = r.table
    assert counted == [(k + 1, len(rows)) for k in range(len(rows))]
    assert list(seen) == [row.name for row in rows] and set(together) == set(seen)
    for name, table in seen.items():
        assert np.allclose(table.to_numpy(float), together[name].to_numpy(float), rtol=0, atol=1e-9, equal_nan=True)
    path = tmp_path / "town" / "gnss" / f"drive={rows[0].name}" / "part-0.parquet"
    table = pq.read_table(path).to_pandas()
    table["quality"] = np.where(table.index == 0, table["quality"], 0)  # a single fix: no start
    pq.write_table(pa.Table.from_pandas(table, preserve_index=False), path)
    fixes[rows[0].name] = UsableFixes.of(tmp_path / "town", rows[0].name)
    skipped = {}
    left = navigate_chunks(shares(1, skip=True), len(rows), skipped=skipped)
    assert [r.drive for r in left] == [row.name for row in rows[1:]] and set(skipped) == {rows[0].name}


@pytest.mark.parametrize("mode", ["segments", "drives"])
def test_an_evaluation_share_by_share(town, mode):
    """Drives scored two at a time and all together: the same segments, outages and biases, errors to rounding."""
    rows = drive_rows(town)
    names = tuple(row.name for row in rows)
    plan = OutagePlan(20.0, (5.0, 10.0))
    work = EvaluationJob(
        str(town), {"mbkf15": MBKF, "ins": build_filter("ins", IMU)}, Protocol(mode, 40.0, 10.0, outage=plan, seed=3),
        {"rate_hz": 20.0, "epoch_s": 1.0}, drive_kinds(town), {row.name: row.group for row in rows},
        law=BiasLaw(0.05, 0.1), shown=False,
    )  # fmt: skip
    one, many = (evaluate_chunks(work, shares) for shares in ([names], [names[:2], names[2:4], names[4:]]))
    assert one.rules["mode"] == mode and one.rules == many.rules and one.scores.outage.any()
    sorted_by = [[(p.drive, p.t_start, k) for k, p in enumerate(e.scores.segments)] for e in (one, many)]
    order = [sorted(range(len(segments)), key=segments.__getitem__) for segments in sorted_by]
    a, b = one.scores, many.scores
    assert [a.segments[k] for k in order[0]] == [b.segments[k] for k in order[1]]
    assert (a.outage[order[0]] == b.outage[order[1]]).all()
    for name in work.filters:  # sums over a batch of another size
        errors = [s.filters[name].error[o] for s, o in zip((a, b), order)]
        assert np.allclose(*errors, rtol=0, atol=1e-8, equal_nan=True)
        followed = [s.filters[name].bias_response[o] for s, o in zip((a, b), order)]
        assert np.allclose(*followed, rtol=0, atol=1e-8, equal_nan=True)
    assert (a.injected_bias[order[0]] == b.injected_bias[order[1]]).all()


def test_shares_of_which_one_has_nothing_to_score(town, tmp_path):
    shutil.copytree(town, tmp_path / "town")
    rows = drive_rows(town)
    path = tmp_path / "town" / "reference" / f"drive={rows[0].name}" / "part-0.parquet"
    table = pq.read_table(path).to_pandas().assign(valid=False)
    pq.write_table(pa.Table.from_pandas(table, preserve_index=False), path)
    work = EvaluationJob(
        str(tmp_path / "town"), {"ins": build_filter("ins", IMU)}, Protocol("segments", 40.0, 10.0),
        {"rate_hz": 20.0, "epoch_s": 1.0}, drive_kinds(town), {}, shown=False,
    )  # fmt: skip
    done = evaluate_chunks(work, [(row.name,) for row in rows[:3]])
    assert {segment.drive for segment in done.scores.segments} == {row.name for row in rows[1:3]}
    short = done.rules["too short"]
    assert short.startswith("1 of 3 drives, too short or") and f"a segment of 40 s: {rows[0].name};" in short
    with pytest.raises(InputError, match="no segment of 40 s"):
        evaluate_chunks(work, [(rows[0].name,)])


@pytest.mark.parametrize("together", [True, False])
def test_drives_too_short_for_a_segment_are_named(town, tmp_path, together):
    """Whatever they share the memory with: mode=auto leaves them out where others have segments, and says so."""
    shutil.copytree(town, tmp_path / "town")
    names = [row.name for row in drive_rows(town)][:4]
    for name in names[:2]:
        path = tmp_path / "town" / "reference" / f"drive={name}" / "part-0.parquet"
        table = pq.read_table(path).to_pandas()
        table["valid"] = table["t"] < table["t"][0] + 30
        pq.write_table(pa.Table.from_pandas(table, preserve_index=False), path)
    work = EvaluationJob(
        str(tmp_path / "town"), {"ins": build_filter("ins", IMU)}, Protocol("auto", 40.0, 10.0),
        {"rate_hz": 20.0, "epoch_s": 1.0}, drive_kinds(town), {}, shown=False,
    )  # fmt: skip
    done = evaluate_chunks(work, [tuple(names)] if together else [(name,) for name in names])
    assert done.rules["mode"] == "segments" and {segment.drive for segment in done.scores.segments} == set(names[2:])
    short = done.rules["too short"]
    assert short.startswith("2 of 4 drives, too short or")
    assert f"40 s with a known attitude: {names[0]}, {names[1]}; " in short and "mode=drives" in short
    shorter = replace(work, protocol=Protocol("auto", 25.0, 10.0))
    assert "too short" not in evaluate_chunks(shorter, [tuple(names)]).rules


def test_models_by_name_and_folder(tmp_path):
    models = resolve_models(["ins", "mbkf15", "mbkf15"], IMU, tuning=Tuning(accel_noise=2.0))
    assert list(models) == ["ins", "mbkf15", "mbkf15#2"] and models["mbkf15"].tuning.accel_noise == 2.0
    prior = Prior([0.0] * 6, [1.0] * 6)
    assert resolve_model("mbkf15_prior", IMU, prior=prior).prior is prior
    smoothed = resolve_models(["plus_rts"], IMU)
    assert list(smoothed) == ["plus_rts"] and isinstance(smoothed["plus_rts"], SmoothedSolution)
    for spec, said in (
        ("mbkf99", "ins, mbkf15"), (str(tmp_path), "no config.yaml"), ("mbkf15_prior", "prior"), ("plud_rts", "plud"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=said):
            resolve_model(spec, IMU)
    (tmp_path / "model.pkl").write_bytes(b"\x80\x04")
    with pytest.raises(InputError, match="is a file"):
        resolve_model(str(tmp_path / "model.pkl"), IMU)
