"""Segments cut by one gather are what cutting by hand gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.data.masks import BiasLaw, add_bias, mask_outage, withhold_fixes
from dlkf.data.segments import (
    Segment,
    StartLaw,
    cut_segments,
    make_batch,
    whole_drives,
)
from dlkf.data.stack import DriveStack
from dlkf.data.store import load_dataset
from dlkf.navigation.attitude import vector_from_rotation
from dlkf.navigation.earth import EARTH_RATE, tangent_frame
from dlkf.navigation.state import NavState
from dlkf.navigation.strapdown import strapdown
from dlkf.running.start import align
from tests.turned import turn_frames

EXACT = StartLaw(0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def drives(town):
    return load_dataset(town, dtype=torch.float64)


def _masked(drive, **rows):
    """A drive with some per-boundary columns changed at some boundaries."""
    changed = {}
    for name, (where, value) in rows.items():
        column = getattr(drive, name).clone()
        column[where] = value
        changed[name] = column
    return replace(drive, **changed)


def test_a_segment_is_the_drives_own_rows_in_its_tangent_frame(drives):
    segments = [Segment(2, 10, 20), Segment(0, 40, 20), Segment(5, 0, 20)]
    batch = make_batch(drives, segments, dtype=torch.float64, start=EXACT)
    assert batch.size == (3, 20, 50) and batch.dt == 0.02 and batch.drive == ("car-2", "car-0", "car-5")
    assert batch.t_start.tolist() == [10.0, 40.0, 0.0]
    for i, (d, first, epochs) in enumerate(segments):
        drive, rows = drives[d], slice(first + 1, first + 1 + epochs)
        assert torch.equal(batch.imu[i], drive.imu[first : first + epochs])
        C_ne, r0 = batch.frame.C_en[i].T, drive.ref_r_e[first]
        for t, row in enumerate(range(first + 1, first + 1 + epochs)):
            assert torch.allclose(batch.truth.p_n[i, t], C_ne @ (drive.ref_r_e[row] - r0), atol=1e-8)
            assert torch.allclose(batch.truth.C_nb[i, t], C_ne @ drive.ref_C_eb[row], atol=1e-12)
            assert torch.allclose(batch.gnss[i, t, :3], C_ne @ (drive.gnss_r_e[row] - r0), atol=1e-8)
            assert torch.allclose(batch.gnss[i, t, 3:], C_ne @ drive.gnss_v_e[row], atol=1e-12)
        assert torch.equal(batch.gnss_std[i], drive.gnss_std[rows])
        assert torch.equal(batch.gnss_valid[i], drive.gnss_valid[rows])
        assert torch.allclose(batch.start.C_nb[i], C_ne @ drive.ref_C_eb[first], atol=1e-12)
    assert batch.start.p_n.abs().max() < 1e-8  # the frame lies at the true start
    assert batch.available.all() and batch.truth_valid.all() and batch.attitude_valid.all()


def test_strapdown_from_the_exact_start_follows_the_truth(drives):
    """A perfect IMU over 20 s: averaging to 50 Hz leaves ω f' dt²/12 = 3e-6 m/s² of sculling, 0.6 mm."""
    batch = make_batch(drives, [Segment(0, 5, 20)], dtype=torch.float64, start=EXACT)
    state = batch.start
    for t in range(20):
        state = strapdown(state, batch.imu[:, t], batch.dt, batch.frame).end
    assert (state.p_n - batch.truth.p_n[:, -1]).norm() < 2e-3
    assert vector_from_rotation(batch.truth.C_nb[:, -1] @ state.C_nb.mT).norm() < 1e-5


def test_start_errors_follow_the_law(drives):
    law = StartLaw(2.0, 0.2, 1.0, 5.0)
    segments = [Segment(0, k % 30, 5) for k in range(4000)]
    g = torch.Generator().manual_seed(3)
    batch = make_batch(DriveStack(drives), segments, dtype=torch.float64, start=law, generator=g)
    exact = make_batch(drives, segments, dtype=torch.float64, start=EXACT)
    dx = batch.start.error_to(exact.start)  # truth ⊖ start, what a filter has to find
    expected = law.std
    assert torch.allclose(batch.start_std[0], expected)
    # 1σ of 4000 draws scatters by 1/√8000 = 1.1 %, the mean by 1/√4000 = 1.6 % of σ
    assert ((dx.std(0) / expected - 1).abs() < 0.05).all() and ((dx.mean(0) / expected).abs() < 0.07).all()


def test_segments_lie_where_the_reference_is_valid(drives):
    holes = _masked(drives[0], ref_valid=([20, 21, 40], False))
    rows = [(p.first, p.first + p.epochs) for p in cut_segments([holes], 10)]
    assert rows == [(0, 10), (22, 32), (41, 51)]
    assert [p.first for p in cut_segments([holes], 10, 5)] == [0, 5, 22, 27, 41, 46]
    assert not cut_segments([holes], 61) and len(cut_segments(drives, 60)) == 6
    with pytest.raises(InputError, match="no segments"):
        make_batch(drives, [])
    with pytest.raises(InputError, match="beyond its drive"):
        make_batch(drives, [Segment(0, 55, 10)])


def test_without_true_attitude_the_start_comes_from_imu_and_gnss(drives):
    blind = _masked(drives[0], ref_C_eb=(slice(None), torch.nan))
    batch = make_batch([blind], [Segment(0, 10, 20)], dtype=torch.float64, start=StartLaw(0.0, 0.0, 9.0, 9.0))
    truth = make_batch(drives, [Segment(0, 10, 20)], dtype=torch.float64, start=EXACT)
    error = vector_from_rotation(truth.start.C_nb @ batch.start.C_nb.mT)
    assert error.norm() < np.radians(0.5) and not batch.attitude_valid.any() and batch.truth_valid.all()
    assert torch.allclose(batch.start.v_n, truth.start.v_n)  # position and velocity from the reference
    assert (batch.start_std[0, 6:] < np.radians(4)).all() and not batch.truth.C_nb.isfinite().any()
    stopped = _masked(blind, gnss_v_e=(slice(None), 0.0))
    assert not cut_segments([stopped], 20)
    with pytest.raises(InputError, match=r"drive car-0: no start state at t = 10\.0"):
        make_batch([stopped], [Segment(0, 10, 20)])


def test_whole_drives_are_padded(drives):
    short = replace(
        drives[1],
        imu=drives[1].imu[:30],
        **{
            n: getattr(drives[1], n)[:31]
            for n in (
                "gnss_r_e", "gnss_v_e", "gnss_std", "gnss_valid", "gnss_lag", "quality",
                "ref_r_e", "ref_v_e", "ref_C_eb", "ref_valid", "ref_imu_error",
            )
        },
    )  # fmt: skip
    pair = [short, drives[0]]
    starts = [align(d) for d in pair]
    batch = whole_drives(pair, starts)
    assert batch.present.sum(1).tolist() == [30 - starts[0].first, 60 - starts[1].first]
    hidden = ~batch.present
    for mask in (batch.available, batch.truth_valid, batch.attitude_valid, batch.gnss_valid.any(-1)):
        assert not (mask & hidden).any()
    assert batch.imu.isfinite().all() and (batch.gnss[hidden] == 0).all()
    alone = batch.select(torch.tensor([1]))
    assert alone.drive == ("car-0",) and torch.equal(alone.imu, batch.imu[1:])


def test_masks(drives):
    batch = make_batch(drives, [Segment(0, 0, 30)])
    out = withhold_fixes(batch, mask_outage(batch, 10, 15))
    assert torch.nonzero(~out.available[0]).flatten().tolist() == list(range(10, 25))  # ends of epochs 11 … 25 s
    assert batch.available.all()


def test_turned_frames_are_the_same_segment(drives):
    """Strapdown in the turned frame ends at the same place: Earth rotation and gravity turn too."""
    plain = make_batch(drives, [Segment(0, 0, 30), Segment(1, 7, 30)], dtype=torch.float64, start=EXACT)
    turned = turn_frames(plain, torch.Generator().manual_seed(0))
    assert not torch.allclose(turned.start.v_n, plain.start.v_n)
    assert torch.allclose(turned.frame.earth_rate_n.norm(dim=-1), torch.tensor(EARTH_RATE, dtype=torch.float64))
    ends = []
    for batch in (plain, turned):
        state = batch.start
        for t in range(30):
            state = strapdown(state, batch.imu[:, t], batch.dt, batch.frame).end
        ends.append((batch.frame.to_ecef(state.p_n), batch.frame.C_en @ state.C_nb))
    assert torch.allclose(ends[0][0], ends[1][0], atol=1e-6) and torch.allclose(ends[0][1], ends[1][1], atol=1e-9)
    for a, b in ((plain.truth.p_n, turned.truth.p_n), (plain.gnss[..., :3], turned.gnss[..., :3])):
        assert torch.allclose(plain.frame.to_ecef(a), turned.frame.to_ecef(b), atol=1e-8)
    assert torch.allclose(plain.gnss_std, turned.gnss_std)  # equal in North and East here


def test_injected_bias_is_in_the_imu_and_in_the_truth(drives):
    known = _masked(drives[0], ref_imu_error=(slice(None), 0.5))
    batch = make_batch([known], [Segment(0, 0, 20)] * 500, dtype=torch.float64)
    noise = torch.randn(500, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    biased = add_bias(batch, BiasLaw(accel_mps2=0.1, gyro_dps=0.3).std * noise)
    bias = biased.imu[:, 0, 0] - batch.imu[:, 0, 0]
    assert torch.allclose(biased.imu - batch.imu, bias[:, None, None].expand_as(batch.imu))
    assert torch.allclose(biased.true_imu_error, 0.5 + bias[:, None].expand(-1, 20, 6))
    sigma = torch.tensor([0.1] * 3 + [np.radians(0.3)] * 3)
    assert ((bias.std(0) / sigma - 1).abs() < 0.15).all()  # 500 draws: 1σ to 3 %


def test_the_error_state_of_a_start_is_truth_minus_estimate():
    frame = tangent_frame(*(torch.zeros(1, dtype=torch.float64) for _ in range(3)))
    truth = NavState(torch.ones(1, 3).double(), torch.ones(1, 3).double(), torch.eye(3).double()[None])
    dx = torch.arange(1.0, 10.0).double()[None] / 100
    assert torch.allclose(truth.correct(-dx).error_to(truth), dx) and frame.height.item() == 0
