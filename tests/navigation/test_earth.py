"""Ellipsoid and gravity against pyproj and python-ins."""

import math

import numpy as np
import pyproj
import pytest
import torch
from pyins import earth as pyins_earth

from dlkf.navigation import compiled
from dlkf.navigation.earth import ecef_from_geodetic, ned_axes, normal_gravity, tangent_frame
from dlkf.navigation.geodetic import _bowring, geodetic_from_ecef

PLACES = np.deg2rad([[52.1, 9.9], [-33.9, 151.2], [0.0, 0.0], [89.5, 179.9], [-75.0, -179.9]])


def test_ecef_agrees_with_pyproj():
    lat, lon = torch.from_numpy(PLACES).T
    height = torch.tensor([80.0, 5.0, 0.0, 2500.0, -20.0], dtype=torch.float64)
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")
    expected = np.stack(to_ecef.transform(*np.rad2deg(PLACES.T), height.numpy()), -1)
    assert np.abs(ecef_from_geodetic(lat, lon, height).numpy() - expected).max() < 1e-6  # rounding of 6.4e6 m


def test_geodetic_undoes_ecef_in_both_forms():
    """By pymap3d, and in tensor operations as an exported filter has it; 1e-11 rad are 0.1 mm."""
    lat, lon = torch.from_numpy(PLACES).T
    for height in (-500.0, 80.0, 9000.0):
        r_e = ecef_from_geodetic(lat, lon, torch.full_like(lat, height))
        for found in (geodetic_from_ecef(r_e), _bowring(r_e)):
            assert max((found[0] - lat).abs().max(), (found[1] - lon).abs().max()) < 1e-11
            assert (found[2] - height).abs().max() < 1e-4


def test_gravity_falls_with_height_as_bruns_says():
    """−∂γ/∂h = γ (1/M + 1/N) + 2 ω² (Heiskanen & Moritz, Physical Geodesy); ours is of first order in f: 4e-5."""
    lat = torch.linspace(-1.5, 1.5, 13, dtype=torch.float64)
    low, here, high = (normal_gravity(torch.sin(lat), torch.full_like(lat, h)) for h in (-50.0, 0.0, 50.0))
    a, e2, omega = 6378137.0, 6.69437999014e-3, 7.292115e-5
    w = 1 - e2 * torch.sin(lat) ** 2
    bruns = here * (w**1.5 / (a * (1 - e2)) + w**0.5 / a) + 2 * omega**2
    assert ((low - high) / 100 / bruns - 1).abs().max() < 5e-5


@pytest.mark.parametrize("height", [0.0, 300.0, 2000.0])
def test_gravity_agrees_with_python_ins(height):
    lat = torch.linspace(-1.5, 1.5, 13, dtype=torch.float64)
    ours = normal_gravity(torch.sin(lat), torch.full_like(lat, height)).numpy()
    theirs = pyins_earth.gravity(np.rad2deg(lat.numpy()), height)
    # theirs drops the flattening in the height term: 0.7 % of 3.1e-6 per metre
    assert np.abs(ours - theirs).max() < 1e-6 + 3.1e-8 * height


@pytest.mark.parametrize("dtype,tolerance", [(torch.float64, 3e-6), (torch.float32, 6e-6)])
def test_plumb_line_tilts_with_the_vehicle(dtype, tolerance):
    """Gravity at a point away from the origin is the local vertical there, in the origin's axes."""
    lat, lon = torch.from_numpy(PLACES).T
    frame = tangent_frame(lat, lon, torch.full_like(lat, 100.0), dtype)
    p_n = torch.tensor([[20e3, -15e3, 40.0]], dtype=torch.float64).expand(len(lat), 3)
    r = frame.to_ecef(p_n).numpy()
    to_llh = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979")
    lat_deg, lon_deg, height = to_llh.transform(*r.T)
    there = ned_axes(torch.from_numpy(np.deg2rad(lat_deg)), torch.from_numpy(np.deg2rad(lon_deg)))
    magnitude = normal_gravity(torch.from_numpy(np.sin(np.deg2rad(lat_deg))), torch.from_numpy(height))
    expected = frame.rotate_from_ecef(magnitude[:, None] * there[..., 2])
    got = frame.gravity(p_n.to(dtype)).double()
    assert (got - expected).abs().max() < tolerance
    # forgetting the tilt would be wrong by g · 25 km / R = 0.04 m/s²
    assert (got[:, :2].norm(dim=-1) > 0.03).all()


@pytest.mark.parametrize(("km", "worst"), [(100, 7e-6), (200, 3e-5), (500, 3e-4)])
def test_gravity_far_from_the_origin_is_as_good_as_is_said(km, worst):
    one = torch.ones(3, dtype=torch.float64)
    frame = tangent_frame(0.9 * one, 0.2 * one, 100 * one)
    turn = km * 1e3 / 6.37e6 * torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64)
    lat, lon = 0.9 + turn, 0.2 + torch.tensor([0.0, 0.0, km * 1e3 / 6.37e6 / math.cos(0.9)], dtype=torch.float64)
    p_n = frame.from_ecef(ecef_from_geodetic(lat, lon, 100 * one))
    true = frame.rotate_from_ecef(normal_gravity(torch.sin(lat), 100 * one)[:, None] * ned_axes(lat, lon)[..., 2])
    error = (frame.gravity(p_n) - true).norm(dim=-1).max()
    assert 0.5 * worst < error < worst


def test_gravity_gradient_matches_differences():
    frame = tangent_frame(*(torch.tensor([x], dtype=torch.float64) for x in (0.9, 0.2, 80.0)))
    step = 100.0
    for axis in range(3):
        d = torch.zeros(1, 3, dtype=torch.float64)
        d[0, axis] = step
        slope = (frame.gravity(d) - frame.gravity(-d))[0, axis] / (2 * step)
        assert abs(float(slope - frame.gravity_gradient()[0, axis])) < 2e-8  # 1 % of 1.5e-6 s⁻²


def test_tangent_round_trip():
    lat, lon = torch.from_numpy(PLACES).T
    frame = tangent_frame(lat, lon, torch.zeros_like(lat))
    p_n = torch.randn(len(lat), 7, 3, dtype=torch.float64) * 1e4
    assert (frame.from_ecef(frame.to_ecef(p_n)) - p_n).abs().max() < 1e-8


def test_compiled_gravity_is_the_tensor_form_s():
    frame = tangent_frame(*(torch.tensor(x, dtype=torch.float64) for x in ([0.9, -0.3], [0.2, 3.0], [80.0, 2500.0])))
    p = torch.tensor([[3e4, -2e4, 150.0], [-500.0, 900.0, -30.0]], dtype=torch.float64)
    with compiled.tensor_forms():
        expected = frame.gravity(p)
    with torch.no_grad():
        assert compiled.fits(p)
        assert (frame.gravity(p) - expected).abs().max() < 1e-13
