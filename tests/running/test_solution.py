"""solution.parquet: geodesy against pymap3d, stds against drawn errors, and the columns of the contract."""

import math

import numpy as np
import pyarrow.parquet as pq
import pymap3d
import torch

from dlkf.navigation.attitude import rotation_from_rpy, rpy_from_rotation
from dlkf.navigation.earth import tangent_frame
from dlkf.navigation.state import NavState
from dlkf.running.solution import COLUMNS, GEO_SCHEMA, solution_table, write_solution

LAT, LON, H = math.radians(60.0), math.radians(25.0), 80.0


def _state(T=50):
    g = torch.Generator().manual_seed(0)
    p = torch.randn(T, 3, generator=g, dtype=torch.float64) * torch.tensor([4e4, 4e4, 50.0])
    v = 20 * torch.randn(T, 3, generator=g, dtype=torch.float64)
    rpy = torch.randn(T, 3, generator=g, dtype=torch.float64) * torch.tensor([0.1, 0.2, 2.0])
    return NavState(p, v, rotation_from_rpy(rpy))


def _frame():
    return tangent_frame(*(torch.tensor([x], dtype=torch.float64) for x in (LAT, LON, H)))


def test_positions_velocities_and_attitude_are_in_true_local_ned():
    frame, state = _frame(), _state()
    T = len(state.p_n)
    table = solution_table(torch.arange(T) + 0.5, frame, state, torch.zeros(T, 6), None, torch.ones(T).bool())
    n, e, d = state.p_n.numpy().T
    lat, lon, h = pymap3d.ned2geodetic(n, e, d, LAT, LON, H, deg=False)
    assert np.allclose(np.radians(table.lat_deg), lat, atol=1e-12)
    assert np.allclose(np.radians(table.lon_deg), lon, atol=1e-12)
    assert np.allclose(table.height_m, h, atol=1e-6)
    u = pymap3d.enu2uvw(state.v_n[:, 1].numpy(), state.v_n[:, 0].numpy(), -state.v_n[:, 2].numpy(), LAT, LON, deg=False)
    east, north, up = pymap3d.uvw2enu(*u, lat, lon, deg=False)
    assert np.allclose(table[["vel_n", "vel_e", "vel_d"]], np.stack((north, east, -up), -1), atol=1e-9)
    # meridians converge: the heading in local NED is the frame's plus Δλ sin φ, to first order
    yaw = rpy_from_rotation(state.C_nb)[:, 2].numpy()
    turn = (table.yaw.to_numpy() - yaw + math.pi) % (2 * math.pi) - math.pi
    near = np.hypot(n, e) < 3e4
    assert np.abs(turn).max() > math.radians(0.5) and np.allclose(
        turn[near], ((lon - LON) * np.sin(lat))[near], atol=2e-3
    )


def test_stds_are_those_of_drawn_errors():
    """Monte Carlo over 40000 draws; 1σ is known to 1/√80000 = 0.35 %, tested to 5 σ."""
    frame, n = _frame(), 40_000
    one = NavState(*(x[:1] for x in _state()))
    std = torch.tensor([1.0, 3.0, 2.0, 0.1, 0.2, 0.3, 1e-3, 2e-3, 4e-3] + [0.02] * 3 + [1e-4] * 3, dtype=torch.float64)
    g = torch.Generator().manual_seed(1)
    dx = std[:9] * torch.randn(n, 9, generator=g, dtype=torch.float64)
    many = NavState(*(x.expand(n, *x.shape[1:]) for x in one)).correct(dx)
    zeros = torch.zeros(n, 6)
    draws = solution_table(torch.zeros(n), frame, many, zeros, None, zeros[:, 0].bool())
    said = solution_table(torch.zeros(1), frame, one, zeros[:1], std[None], zeros[:1, 0].bool()).iloc[0]
    for column in ("vel_n", "vel_e", "vel_d", "roll", "pitch", "yaw"):
        assert np.isclose(said[f"std_{column}"], draws[column].std(), rtol=0.018), column
    metres = np.radians(draws.lat_deg).std() * 6.38e6 * (1 - 0.0033 * math.cos(2 * LAT) - 0.0017)
    assert np.isclose(said.std_pos_n, metres, rtol=0.025)  # radius of the meridian to half a percent
    assert np.isclose(said.std_pos_d, draws.height_m.std(), rtol=0.018)
    assert said.std_accel_error_x == 0.02 and np.isclose(said.std_gyro_error_z, 1e-4)


def test_the_file_has_the_contract_columns_and_keeps_nan(tmp_path):
    T = 5
    state = NavState(*(x[:T] for x in _state()))
    table = solution_table(torch.arange(T), _frame(), state, torch.ones(T, 6), None, torch.arange(T) > 2)
    write_solution(tmp_path / "drive=a" / "solution.parquet", table)
    back = pq.read_table(tmp_path / "drive=a" / "solution.parquet")
    assert back.schema.equals(GEO_SCHEMA) and back.column_names == [*COLUMNS, "gnss_used", "geometry"]
    assert back["std_yaw"].null_count == 0 and all(math.isnan(x) for x in back["std_yaw"].to_pylist())
    assert back["gnss_used"].to_pylist() == [False, False, False, True, True]
    assert [p.name for p in (tmp_path / "drive=a").iterdir()] == ["solution.parquet"]
