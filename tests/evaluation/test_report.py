"""Tables, figures and files of a report; what has no truth is a dash, what broke is ∞."""

import csv
import io
import json
import math
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb

from dlkf.base.errors import InputError
from dlkf.base.files import write_into
from dlkf.data.kinds import drive_kind
from dlkf.evaluation import figures
from dlkf.evaluation.figures import png
from dlkf.evaluation.metrics import QUANTITIES
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.results import IMU_AXES, Results, summarise_scores
from dlkf.evaluation.scores import FilterRun, representative
from dlkf.evaluation.summary import describe_untuned, describe_verdict, headline
from dlkf.evaluation.table import (
    as_csv,
    as_json,
    as_markdown,
    format_interval,
    format_number,
    format_ratios,
    ratio_table,
    result_tables,
    slope_table,
)
from dlkf.filters.build import build_filter
from dlkf.filters.tuning import Tuning
from dlkf.report.compare import StoredReport, describe_tests, end_table, mark_best_of_each, shorten_names
from dlkf.report.evaluation import describe_average, evaluation_page, least_error, outage_rows, write_report
from dlkf.report.page import format_setting
from dlkf.report.training import learning_curve
from tests.cars import IMU
from tests.evaluation.drawn import figures_of
from tests.evaluation.scoring import score

FILTERS = {name: build_filter(name, IMU) for name in ("ins", "mbkf15")}


@pytest.fixture(scope="module")
def scores(cars):
    outages = OutagePlan(first_s=30, duration_s=20).masks(cars)
    return score(FILTERS, [cars], outages=outages, kinds="simulated")


def test_numbers_are_plain():
    assert [format_number(x) for x in (math.nan, math.inf, 0.0, 0.99961, 12.345, 1234.5, 0.01234)] == [
        "–", "∞", "0", "1.00", "12.3", "1234", "0.0123",
    ]  # fmt: skip


def test_tables_hold_the_summarise_scores(scores):
    r = summarise_scores(scores, resamples=200)
    whole, outages = result_tables("town", r)
    assert whole.title == "town (simulated): 6 segments, 6 drives"
    assert outages.title == "town (simulated): 6 outages of 20 s, 6 drives"
    end = {s: r.value("mbkf15", "outages", "end", "horizontal", s) for s in ("rms", "median", "p95")}
    assert outages.rows[1][:4] == ["mbkf15", *map(format_number, end.values())]
    ratios = ratio_table("town", r)
    assert ratios.title.endswith("ratio to mbkf15, 6 recordings") and [row[0] for row in ratios.rows] == ["ins"]
    assert len(ratios.columns) == 6 and all(cell.endswith(" (n<8)") for cell in ratios.rows[0][1:])
    assert ratio_table("town", summarise_scores(scores, baseline="none such")) is None
    assert len(r.comparisons) == 2 * 6 * 3 and r.baseline == "mbkf15"
    assert all(c.filter == "ins" and c.groups == 6 for c in r.comparisons)
    at_end = [format_number(r.value("mbkf15", "outages", "end", "horizontal", s)) for s in ("median", "max", "p95")]
    few = headline(r)
    assert few.startswith(f"20 s without GNSS, 6 outages: mbkf15 ends {at_end[0]} m from the reference in the median (")
    assert f" % of the distance driven), {at_end[1]} m in the largest; next ins " in few
    assert few.endswith(" Based on 6 outages only; larger errors can occur.")
    names = {"mbkf15": "mbkf15_rts", "ins": "ins"}
    smoothed = headline(replace(r, values=[v._replace(filter=names[v.filter]) for v in r.values]))
    assert ": ins ends " in smoothed and f"smallest: mbkf15_rts {at_end[0]} m" in smoothed
    many, one = (replace(r, count={**r.count, "outages": n}) for n in (20, 1))
    assert f" % of the distance driven), within {at_end[2]} m in 95 % of them; " in headline(many)
    assert headline(one).startswith(f"20 s without GNSS, 1 outage: mbkf15 ends {at_end[0]} m from the reference (")
    longer = replace(r, count={**r.count, "outage_s": [30.0, 50.0]})
    assert headline(longer).startswith("30 to 50 s without GNSS, ")
    verdict = describe_verdict(r, "ins")
    assert verdict.startswith("ins: ") and "; mbkf15 " in verdict and "; ins : mbkf15 = " in verdict
    assert verdict.endswith(" by geometric mean: worse, but too few recordings for an interval.")
    enough = [replace(c, groups=8, ratio=0.7, ratio_low=0.6, ratio_high=0.8) for c in r.comparisons]
    assert "ins : mbkf15 = 0.70 [0.60, 0.80] by geometric mean: better" in describe_verdict(
        replace(r, comparisons=enough), "ins"
    )
    for ratio in (1.0, float("nan")):  # alike, or both broke
        alike = replace(r, comparisons=[replace(c, ratio=ratio) for c in r.comparisons])
        assert " by geometric mean: neither is better, but too few" in describe_verdict(alike, "ins")
    assert describe_verdict(r, "none such") is None
    few = r.versus("ins", "outages", "end", "horizontal")
    assert format_interval(replace(few, groups=8, ratio=0.7, ratio_low=0.6, ratio_high=0.8)) == "0.70 [0.60–0.80]"
    assert few.a == r.value("ins", "outages", "end", "horizontal")
    assert r.versus("mbkf15", "outages", "end", "heading") is None
    last = r.seconds_into_outage()[-1]
    for q, s in product(QUANTITIES, ("rms", "geomean", "n")):
        assert r.value("mbkf15", "outages", f"at {last} s", q, s) == r.value("mbkf15", "outages", "end", q, s)
    per_outage = [o["end"]["mbkf15"]["horizontal"] for o in r.per_outage]
    assert math.sqrt(np.mean(np.square(per_outage))) == pytest.approx(end["rms"])
    assert all(len(row) == len(t.columns) for t in (whole, outages) for row in t.rows)
    markdown = as_markdown(whole)
    assert markdown.count("\n| ") == 3 and "| mbkf15 |" in markdown


def test_gnss_is_throughout_only_where_no_fix_lacks_for_long(cars):
    """A gap of the drive's own is named, whether fixes are missing or not valid; what comes after the truth is none."""
    valid, available, truth = cars.gnss_valid.clone(), cars.available.clone(), cars.truth_valid.clone()
    valid[0, 20:32, :3] = False
    available[1, 20:25] = False
    available[2, 45:] = truth[2, 45:] = False
    batch = replace(cars, gnss_valid=valid, available=available, truth_valid=truth)

    def say(row):
        one = score(FILTERS, [batch.select(torch.tensor([row]))])
        return headline(summarise_scores(one, resamples=50))

    assert say(0).startswith("With all fixes of the drives, at most 12 s without one: mbkf15 is ")
    assert all(say(row).startswith("With GNSS throughout: mbkf15 is ") for row in (1, 2))
    both = summarise_scores(score(FILTERS, [batch.select(torch.tensor([k])) for k in (0, 1)]), resamples=50)
    assert both.count["longest_without_fix_s"] == 12.0
    older = replace(both, count={k: v for k, v in both.count.items() if k != "longest_without_fix_s"})
    assert headline(older).startswith("With all fixes of the drives: mbkf15 is ")


def test_a_bound_of_a_ratio_reads_on_its_side_of_1():
    """Whether 1 is in the interval is what a reader looks for."""
    for bounds, said in (
        ((0.9225, 0.8627, 1.0095), ["0.92", "0.86", "1.01"]),
        ((0.9225, 0.8627, 1.0045), ["0.922", "0.863", "1.004"]),
        ((0.98, 0.95, 0.9996), ["0.9800", "0.9500", "0.9996"]),
        ((1.0, 0.012, 12.345), ["1.00", "0.012", "12.3"]),
        ((math.nan, math.inf), ["–", "∞"]),
    ):
        assert format_ratios(*bounds) == said


def test_drift_says_of_how_many_outages_it_is(scores):
    """A car that stands has no error per distance; a reference that begins just after the last fix takes none away."""
    truth = scores.truth_v_n.copy()
    truth[0], truth[1, 29] = 0.0, np.nan
    (_, table), (_, before) = (
        result_tables("town", summarise_scores(s, resamples=50)) for s in (replace(scores, truth_v_n=truth), scores)
    )
    assert "(median over the 5 outages of more than 1 m)" in table.note and "(median)" in before.note


def test_the_recordings_of_a_ratio_are_those_that_have_it(scores):
    """Fewer drives have an outage than a segment: then every column says of how many it is."""
    part = replace(scores, outage=scores.outage & (np.arange(6) < 2)[:, None])
    ratios = ratio_table("town", summarise_scores(part, resamples=50))
    assert ratios.title.endswith("ratio to mbkf15")
    counts = [column.rpartition("\n")[2] for column in ratios.columns[1:]]
    assert counts == ["2 recordings"] * 2 + ["6 recordings"] * 3


def test_kalman_filters_that_nobody_tuned_are_named_beside_a_learned_one():
    said = describe_untuned(["ins", "mbkf15", "mbkf21_car", "plus"], Tuning(), "consumer")
    assert said is not None and said.startswith("mbkf15, mbkf21_car: noise of imu=consumer as it stands, untuned")
    for names, tuning in (["mbkf15", "plus"], Tuning(accel_noise=25.0)), (["ins", "plus"], Tuning()):
        assert describe_untuned(names, tuning, "consumer") is None
    assert describe_untuned(["mbkf15", "mbkf21"], Tuning(), "consumer") is None


def test_csv_and_json_carry_every_value(scores):
    r = summarise_scores(scores, resamples=50)
    rows = list(csv.DictReader(io.StringIO(as_csv("town", [r]))))
    (value,) = (
        row["value"]
        for row in rows
        if (row["filter"], row["part"], row["quantity"], row["statistic"]) == ("ins", "at 10 s", "velocity", "p95")
    )
    assert float(value) == r.value("ins", "outages", "at 10 s", "velocity", "p95") and len(rows) == len(r.values)
    again = Results.of(json.loads(as_json(r.as_dict())))
    for part in ("values", "comparisons", "count"):
        assert repr(getattr(again, part)) == repr(getattr(r, part))
    content = json.loads(
        as_json({"r": r.as_dict(), "nan": math.nan, "inf": np.float64(-np.inf)}), parse_constant=pytest.fail
    )
    assert content["nan"] is None and content["inf"] == "-inf" and len(content["r"]["per_segment"]) == 6


def test_missing_attitude_is_a_dash_and_a_broken_filter_infinite(cars):
    batch = replace(cars, attitude_valid=torch.zeros_like(cars.attitude_valid))
    scores = score(FILTERS, [batch], kinds="real")
    scores.filters["ins"].error[0, 20, :3] = np.inf
    r = summarise_scores(scores, resamples=50)
    (whole,) = result_tables("town", r)
    column = {c: i for i, c in enumerate(whole.columns)}
    assert all(row[column["Attitude\n[°]"]] == "–" and row[column["Heading\n[°]"]] == "–" for row in whole.rows)
    assert whole.rows[0][column["3D\n[m]"]] == "∞" and whole.rows[0][column["Not\nfinite"]] == "1 segment"
    assert float(whole.rows[1][column["3D\n[m]"]]) < 1
    content = json.loads(as_json(r.as_dict()))
    assert ["real", "ins", "segments", "all", "position", "rms", "inf", "m"] in content["values"]["data"]
    assert Results.of(content).value("ins", "segments", "all", "position") == math.inf


def test_kinds_of_data_are_never_mixed(cars):
    mixed = score(FILTERS, [cars], kinds={"car-00": "real"})
    with pytest.raises(ValueError, match="must not be mixed"):
        summarise_scores(mixed)
    assert [summarise_scores(mixed.of_kind(k)).count["segments"] for k in mixed.kinds] == [1, 5]


def test_slope_over_drives_of_known_error(scores, cars):
    r = summarise_scores(scores, resamples=50)
    slopes = {n: [r.value(n, "segments", "last", axis, "slope") for axis in IMU_AXES] for n in FILTERS}
    assert np.allclose(slopes["mbkf15"][2:5], 1.0, atol=0.1) and np.allclose(slopes["ins"], 0.0)
    assert slope_table("town", r).rows[0][1:] == ["0"] * 6
    unknown = replace(cars, true_imu_error=torch.full_like(cars.true_imu_error, math.nan))
    assert slope_table("town", summarise_scores(score(FILTERS, [unknown], kinds="real"), resamples=50)) is None


def test_kind_of_a_drive():
    assert drive_kind({"source": "dlkf.simulate"}) == "simulated"
    assert drive_kind({"source": "KITTI raw", "gnss": "SYNTHETIC from the reference"}) == "semi-real"
    assert drive_kind({"source": "car", "gnss": "u-blox F9P", "imu": "consumer MEMS"}) == "real"
    assert drive_kind({"source": "car", "kind": "semi-real"}) == "semi-real"
    with pytest.raises(InputError, match="none of simulated"):
        drive_kind({"drive": "a", "kind": "fake"})


@pytest.mark.whole
@pytest.mark.parametrize("draw", ["tracks", "over_time", "imu", "growth", "spread"])
def test_figures_have_content(scores, draw):
    figure = {
        "tracks": lambda: figures.tracks(scores, [0, 3]),
        "over_time": lambda: figures.error_over_time(scores),
        "imu": lambda: figures.imu_errors(scores, 1),
        "growth": lambda: figures.error_growth(scores),
        "spread": lambda: figures.error_histograms(scores, list(scores.filters)[:2]),
    }[draw]()
    data = png(figure, dpi=40)
    assert data.startswith(b"\x89PNG") and len(data) > 5000
    assert all(ax.get_xlabel() or ax.get_shared_x_axes() for ax in figure.axes)


def test_figures_say_what_is_drawn_in_which_colour(scores):
    """A histogram names the filters that it has, and counts in whole outages; a band has no filter's colour."""
    names = list(scores.filters)
    both, one = (figures.error_histograms(scores, drawn) for drawn in (names, names[-1:]))
    assert both.get_suptitle() == "" and one.get_suptitle() == f"1 of {len(names)} filters: {names[-1]}"
    for figure in (both, one):
        assert all(tick == round(tick) for ax in figure.axes if ax.get_visible() for tick in ax.get_yticks())
    legend = figures.imu_errors(scores, 1).legends[0]
    patches = {t.get_text(): patch for t, patch in zip(legend.get_texts(), legend.legend_handles)}
    colours = [to_rgb(patches[name].get_color()) for name in patches if name in names]
    band = to_rgb(patches["±3σ, in the colour of each filter"].get_facecolor())
    assert colours and len(set(band)) == 1 and band not in colours


def test_an_empty_list_is_none_and_not_unknown():
    """``aids=[]`` beside ``aids=[speed]``."""
    assert [format_setting(x) for x in ([], ["speed", "baro"], None, {})] == ["none", "speed, baro", "–", "–"]


@pytest.mark.whole
def test_figures_survive_missing_truth_and_broken_filters(cars):
    truth = cars.truth_valid.clone()
    truth[:, :7] = truth[0, 30:] = False
    batch = replace(cars, truth_valid=truth, attitude_valid=torch.zeros_like(truth))
    outages = OutagePlan(first_s=20, duration_s=20).masks(batch)
    s = score(FILTERS, [batch], outages=outages, kinds="real")
    for run in s.filters.values():
        run.error[1, 15:], run.p_n[1, 15:], run.imu_error[1, 15:] = np.inf, np.nan, np.nan
    segments = representative(s, 4, "mbkf15")
    for figure in (figures.tracks(s, segments), figures.error_over_time(s), figures.error_growth(s)):
        assert len(png(figure, dpi=30)) > 4000
    assert len(png(figures.imu_errors(s, 1), dpi=30)) > 4000


@pytest.mark.whole
def test_report_is_complete_and_replaces_an_older_one(scores, tmp_path):
    out = tmp_path / "a" / "b"
    out.mkdir(parents=True)
    (out / "table.md").write_text("old")
    write_report(
        out, "town", scores, [summarise_scores(scores, resamples=50)],
        protocol={"mode": "segments"}, by_time=True, baseline="mbkf15", figures=True,
        warnings=["dlkf was trained on 3"],
    )  # fmt: skip
    assert "dlkf was trained on 3" in json.loads((out / "metrics.json").read_text())["warnings"]
    assert all("dlkf was trained on 3" in (out / name).read_text() for name in ("table.md", "report.html"))
    assert (out / "table.md").read_text().startswith("**town (simulated)")
    assert all(p.stat().st_size > 100 for p in out.rglob("*") if p.is_file())
    names = {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()}
    assert {"metrics.json", "table.md", "table.csv", "report.html", "figures/tracks.png"} <= names
    assert not any("partial" in n for n in names)
    page = (out / "report.html").read_text()
    assert len(figures_of(page)) >= 4
    assert "<img" not in page and "<script src" not in page and "<link" not in page
    assert page.count("class=figure") == 4 and "20 s without GNSS, " in page.partition("<h2>")[0]


def test_the_page_of_a_training_begins_with_what_was_trained(scores):
    results = [summarise_scores(scores, resamples=50)]
    page = evaluation_page("town", [], scores, results, {}, "mbkf15", trained="ins")
    top = page.partition("<h2>")[0]
    assert (
        0 < top.index("ins: ") < top.index("20 s without GNSS, ") and "m RMS at the end of the outages; mbkf15" in top
    )


@pytest.mark.parametrize(("at_end", "panels"), [([math.nan, 12.0], 2), ([math.nan] * 2, 1)])
def test_the_page_of_a_training_has_its_losses(scores, at_end, panels):
    losses = {"epoch": [1.0, 2.0], "train/loss": [2.0, 1.0], "val/loss": [math.nan, 1.5], "val/outage_end_m": at_end}
    results = [summarise_scores(scores, resamples=50)]
    page = evaluation_page("town", [], scores, results, {}, "mbkf15", trained="ins", losses=losses)
    assert "<h1>Training of ins and evaluation on town</h1>" in page
    assert len(figures_of(page)["training"].data) == panels + 1
    assert [trace["y"].tolist() for trace in learning_curve(losses).data][:2] == [[2.0, 1.0], [1.5]]


def test_only_what_is_drawn_is_called_the_truth(scores):
    results = [summarise_scores(scores, resamples=50)]
    page = evaluation_page("town", [], scores, results, {}, "mbkf15")
    assert "black: truth" in page and "The truth, the outages" in page
    unknown = replace(scores, true_imu_error=np.full_like(scores.true_imu_error, np.nan))
    page = evaluation_page("town", [], unknown, results, {"reference": "smoothed solution"}, "mbkf15")
    assert "black: truth" not in page and "The reference, the outages" in page
    legend = figures.tracks(scores, [0], "reference").legends[0]
    assert [text.get_text() for text in legend.get_texts()][:2] == ["reference", "outage"]


def test_pictures_of_runs_over_one_drive_have_titles_of_their_own(scores):
    other = np.roll(scores.outage[:1], 10, 1)
    twice = replace(scores, outage=np.concatenate((scores.outage[:1], other)), segments=scores.segments[:1] * 2)
    first, second = (twice.describe_segment(i) for i in range(2))
    assert first.partition(", ")[0] == second.partition(", ")[0] and first != second


def test_the_average_over_time_says_over_what_and_whether_anything_is_grey(scores):
    count = len(scores.segments)
    assert describe_average(scores) == f"RMS over {count} segments; grey where most of them have an outage."
    twice = replace(scores, segments=scores.segments * 2, outage=np.concatenate((scores.outage, ~scores.outage)))
    said = f"RMS over {2 * count} runs ({count} drives, each with outages at 2 offsets); grey where most of them have"
    assert describe_average(twice) == f"{said} an outage (here nowhere)."
    assert describe_average(replace(scores, outage=scores.outage & False)) == f"RMS over {count} segments."


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_representative_segments_are_different_ones(scores, n):
    for count in range(n, len(scores.segments) + 1):
        run = FilterRun(*(x[:count] for x in vars(scores.filters["ins"]).values()))
        part = replace(scores, outage=scores.outage[:count], filters={"ins": run})
        assert len(set(representative(part, n, "ins"))) == n


def test_outages_stand_in_the_order_of_the_best_filter(scores):
    result = summarise_scores(scores, resamples=50)
    names = list(scores.filters)
    medians = [result.value(name, "outages", "end", "horizontal", "median") for name in names]
    best = least_error(scores, result)
    assert medians[names.index(best)] == min(medians)
    for name in names:
        columns, rows, _ = outage_rows(scores, result, "map", name)
        errors = [float(row[columns.index(name)]) for row in rows]
        assert len(errors) > 2 and errors == sorted(errors, reverse=True)
    page = evaluation_page("town", [], scores, [result], {}, "mbkf15")
    assert f"<h2>Outages ({len(result.per_outage)})</h2>" in page and "scroll in the box" not in page


def test_a_failed_write_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError), write_into(tmp_path / "new" / "deep") as folder:
        (folder / "x").write_text("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"), write_into(tmp_path / "file" / "sub"):
        pass


@pytest.mark.parametrize(
    ("folders", "names"),
    [
        (("/a/outputs/x", "/b/home/y"), ["x", "y"]),
        (("/a/outputs/x/report", "/b/home/y"), ["x", "y"]),
        (("/a/town/x", "/a/city/x", "/a/city/y"), ["town/x", "city/x", "y"]),
        (("/x", "/a/x", "/y"), ["/x", "a/x", "y"]),  # one is the end of the other
        (
            ("/s/0-model=plus,aids=[]", "/s/1-model=plus,aids=[speed,baro]"),
            ["plus, aids=[]", "plus, aids=[speed,baro]"],
        ),
        (("/s/0-imu=a", "/s/3-imu=a"), ["0-imu=a", "3-imu=a"]),
    ],
)
def test_runs_are_named_by_the_least_that_tells_them_apart(folders, names):
    assert shorten_names([Path(f) for f in folders]) == names


def test_the_best_is_marked_among_those_of_the_same_test(scores):
    """Other data or other outages are another test, another IMU preset is not; one row alone is no comparison."""
    results = [summarise_scores(scores, resamples=200)]
    said = [("a", "town", {"seed": 0, "imu": "x"}), ("b", "town", {"seed": 0, "imu": "y"}), ("c", "city", {"seed": 0})]
    reports = [
        StoredReport(name, name, data, rules, results) for name, data, rules in (*said, ("d", "city", {"seed": 1}))
    ]
    columns, rows = end_table(reports)
    by_test = describe_tests(reports)
    assert [by_test.index(t) for t in by_test[:: len(FILTERS)]] == [0, 0, 4, 6]
    marked = [row[0] for row, mark in zip(rows, mark_best_of_each(columns, rows, by_test)) if mark]
    assert marked == ["a", "c", "d"]
    assert mark_best_of_each(columns, rows[:2], ["one", "another"]) == ["", ""]
