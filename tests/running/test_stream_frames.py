"""The tangent frame that follows a stream."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dlkf.navigation.earth import tangent_frame
from dlkf.navigation.state import NavState
from dlkf.running.reanchoring import FrameChange
from dlkf.running.streaming import StreamingFilter
from tests.running.streams import ARM, apart, estimator, network, some, table


@pytest.mark.whole
@pytest.mark.parametrize(
    "name,metres",
    # with an outage of 25 s: gravity is good to 1e-8 m/s² within a kilometre, the linear model to its square
    [
        ("mbkf21_nhc_gated", 1e-4),
        pytest.param("dlkf_kalman_mbkf21_car", 1e-1, marks=pytest.mark.commands),
        ("plus", 2e-3),
        ("aekf", 1e-2),
        ("ins", 2e-2),
    ],
)
def test_moving_the_frame_along_changes_nothing(drive, name, metres):
    tables = some(drive, (drive.gnss["t"] < 25) | (drive.gnss["t"] > 50), "gnss")
    still, moving = (StreamingFilter(estimator(name), lever_arm_b=ARM, anchor_m=m) for m in (1e9, 100.0))
    late = 2.2 if "gated" in name else 0.0  # a replay may cross a change of frame
    a, b = (table(s, tables, arrival=tables.gnss["t"] + late) for s in (still, moving))
    columns = [c for c in a if not c.startswith("std")]  # those of vectors turn as if uncorrelated
    assert apart(a[columns], b[columns]) < metres
    assert float(moving.latest.state.p_n.norm()) < 150 < float(still.latest.state.p_n.norm())


def test_a_network_of_the_heading_frame_moves_along(drive):
    """What it sees of the tilt of n against the vertical, 1e-4 rad here, is all that differs."""
    still, moving, blind = (
        StreamingFilter(network(frame=f, outage_mode="run"), lever_arm_b=ARM, anchor_m=m)
        for f, m in (("heading", 1e9), ("heading", 100.0), ("ned", 100.0))
    )
    a, b, other = (table(s, drive) for s in (still, moving, blind))
    assert apart(a[["lat_deg", "lon_deg"]], b[["lat_deg", "lon_deg"]]) < 0.1
    assert np.isfinite(other["lat_deg"]).all() and float(blind.latest.state.p_n.norm()) < 200


def test_a_change_of_frame_keeps_position_velocity_and_attitude_in_ecef():
    g = torch.Generator().manual_seed(0)
    one = torch.ones(3, dtype=torch.float64)
    old, new = (tangent_frame(lat * one, lon * one, 100 * one) for lat, lon in ((0.9, 0.2), (0.91, 0.21)))
    p, v = (1e4 * torch.randn(3, 3, generator=g, dtype=torch.float64) for _ in range(2))
    C = torch.linalg.qr(torch.randn(3, 3, 3, generator=g, dtype=torch.float64))[0]
    L = torch.randn(3, 16, 16, generator=g, dtype=torch.float64)
    change, state = FrameChange(old, new), NavState(p, v, C)
    moved = change.state(state)
    assert (new.to_ecef(moved.p_n) - old.to_ecef(p)).abs().max() < 1e-8
    assert (new.rotate_to_ecef(moved.v_n) - old.rotate_to_ecef(v)).abs().max() < 1e-8
    assert (new.C_en @ moved.C_nb - old.C_en @ C).abs().max() < 1e-14
    # an error x with covariance P is the vector x' = T x: its normalised square does not change
    P, x = L @ L.mT, torch.randn(3, 16, generator=g, dtype=torch.float64)
    turned = torch.cat((change.vectors(x[:, :9]), x[:, 9:]), -1)
    a, b = ((y * torch.linalg.solve(Q, y)).sum(-1) for y, Q in ((x, P), (turned, change.covariance(P))))
    assert torch.allclose(a, b, rtol=1e-6)


def test_variances_of_components_turn_with_the_axes():
    """The diagonal of C R Cᵀ for a diagonal R, three components at a time, half the Earth's way apart."""
    places = ((0.9, 0.2), (-0.3, 1.7))
    old, new = (tangent_frame(*(torch.tensor([x], dtype=torch.float64) for x in (*place, 0.0))) for place in places)
    change, R = FrameChange(old, new), torch.tensor([[1.0, 4.0, 9.0, 0.25, 16.0, 2.0]], dtype=torch.float64)
    turned = [(change.turn @ R[:, k : k + 3].diag_embed() @ change.turn.mT).diagonal(dim1=1, dim2=2) for k in (0, 3)]
    assert torch.allclose(change.variances(R), torch.cat(turned, -1), rtol=1e-12)
