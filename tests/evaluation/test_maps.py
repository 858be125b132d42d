"""A map shows the drives, wherever they lie."""

import numpy as np
import pytest

from dlkf.report.maps import add_track, chart, find_areas, in_metres

SIZE = 0.005  # ° of a drive


def drive(lat, lon, size=SIZE):
    """A diagonal from a corner."""
    return np.stack((np.linspace(lat, lat + size, 50), np.linspace(lon, lon + size, 50)), -1)


def map_of(places):
    return chart([add_track(place, name, "#000000", width=2) for name, place in places.items()], places).layout["meta"]


def test_drives_of_two_continents_are_two_areas_without_a_view_of_both():
    meta = map_of({"a": drive(49.0, 8.4), "b": drive(40.1, -105.1), "c": drive(49.007, 8.4)})
    assert [area["name"] for area in meta["areas"]] == ["a, c", "b"] and meta["first"] == 0
    assert meta["areas"][0]["lat"] == pytest.approx(49.006) and meta["areas"][1]["half_lat"] == pytest.approx(0.0027)


@pytest.mark.parametrize("size,first", [(4 * SIZE, 0), (SIZE, 1)])  # of the first: all are 2.4 or 3.1 times as wide
def test_drives_of_one_town_are_seen_together_unless_they_were_specks(size, first):
    meta = map_of({"a": drive(49.0, 8.4, size), "b": drive(49.0 + 2.1 * size, 8.4)})
    assert [area["name"] for area in meta["areas"]] == ["all 2 drives", "a", "b"] and meta["first"] == first


def test_neighbours_and_what_has_no_place_make_no_area_of_their_own():
    areas = find_areas({"a": drive(49.0, 8.4), "b": drive(49.004, 8.4), "lost": np.full((3, 2), np.nan)})
    assert [area.name for area in areas] == ["a, b"] and chart([add_track(np.empty((0, 2)), "a", "#000000", width=1)])


def test_a_map_in_metres_has_axes_of_equal_scale():
    """0.005° are 556 m to the north, and 365 m to the east at 49°."""
    place = drive(49.0, 8.4)
    figure = in_metres(chart([add_track(place, "a", "#000000", width=2)], {"a": place}))
    (trace,) = figure.data
    assert trace["type"] == "scatter" and "map" not in figure.layout and figure.layout["yaxis"]["scaleanchor"] == "x"
    assert np.ptp(trace["x"]) == pytest.approx(365, abs=1) and np.ptp(trace["y"]) == pytest.approx(556, abs=1)
    assert figure.layout["xaxis"]["title"]["text"] == "East of 8.40250° [m]"
