"""What stands along the road: fronts of houses, tunnels, the same at any sample rate."""

import math

import numpy as np
import pytest

from dlkf.base.errors import InputError
from dlkf.simulation.gnss.surroundings import Surroundings, sky_along

DISTANCE = np.arange(0.0, 200_000.0, 1.0)


def test_open_country_hides_nothing():
    sky = sky_along(np.random.default_rng(1), Surroundings(), DISTANCE)
    assert not sky.mask_left.any() and not sky.mask_right.any() and not sky.blocked.any()


def test_house_fronts_have_the_stated_statistics():
    """200 km hold 8000 fronts a side: share built within 2 %, median mask within 2 % of atan(h/(1.07 d))."""
    street = Surroundings(building_height=14.0, building_distance=14.0, front_length=25.0, built_share=0.8)
    sky = sky_along(np.random.default_rng(2), street, DISTANCE)
    for mask in (sky.mask_left, sky.mask_right):
        assert np.mean(mask > 0) == pytest.approx(0.8, abs=0.02)
        assert np.median(np.tan(mask[mask > 0])) == pytest.approx(1 / 1.07, rel=0.04)
        assert mask.max() < math.pi / 2
        assert np.mean(np.diff(mask) != 0) == pytest.approx(1 / 25, rel=0.1)
    assert np.abs(np.corrcoef(sky.mask_left, sky.mask_right)[0, 1]) < 0.1
    assert not sky.blocked.any()


def test_tunnels_have_the_stated_lengths():
    hills = Surroundings(tunnel_length=500.0, tunnel_spacing=1500.0)
    blocked = sky_along(np.random.default_rng(3), hills, DISTANCE).blocked
    ends = np.flatnonzero(np.diff(blocked.astype(int)))
    lengths = np.diff(ends)[::2]
    assert not blocked[0] and len(lengths) > 80
    assert lengths.mean() == pytest.approx(500, rel=0.1)
    assert lengths.min() >= 249 and lengths.max() <= 751
    assert np.diff(ends)[1::2].mean() == pytest.approx(1500, rel=0.1)


def test_the_road_is_the_same_at_any_sample_rate_and_for_a_standing_car():
    street = Surroundings(building_height=10.0, tunnel_length=50.0, tunnel_spacing=200.0)
    distance = np.concatenate((np.linspace(0, 900, 1001), np.full(500, 900.0), np.linspace(900, 1500, 501)))
    fine = sky_along(np.random.default_rng(4), street, distance)
    coarse = sky_along(np.random.default_rng(4), street, distance[::2])
    for name in ("mask_left", "mask_right", "blocked"):
        assert np.array_equal(getattr(fine, name)[::2], getattr(coarse, name))
        assert len(np.unique(getattr(fine, name)[1001:1500])) == 1
        assert len(np.unique(getattr(fine, name))) > 1


@pytest.mark.parametrize(
    "change",
    [
        {"building_height": -1.0},
        {"built_share": 1.5},
        {"front_length": 0.0},
        {"tunnel_length": 2.0},
        {"tunnel_spacing": math.nan},
    ],
)
def test_impossible_surroundings_are_one_clear_line(change):
    with pytest.raises(InputError, match=next(iter(change))) as caught:
        Surroundings(**change)
    assert "\n" not in str(caught.value)
