"""The comparison of plus with its rivals on a small dataset: outages, ratios, and the filters that it names."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dlkf.filters.build import build_filter
from dlkf.filters.plus import PlusFilter
from dlkf.filters.shipped import trained_filter
from tests.filters.scene import IMU, scene

FILE = Path(__file__).parents[2] / "pipelines" / "studies" / "plus.py"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("plus_study", FILE)
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules["plus_study"] = module
    spec.loader.exec_module(module)
    return module


def test_every_rival_is_a_tuning_that_anybody_can_name(study):
    found = study.constants()
    names = [name + more for name in study.CONSTANTS for more in ("", study.SOURCES)]
    rivals = {f"{name} {t}" for name in names for t in study.CONSTANTS[name.partition("+")[0]]}
    assert set(found) == rivals
    plus = trained_filter("plus")
    assert isinstance(plus, PlusFilter)
    assert found["mbkf33_car any_car"].tuning == plus.tuning  # where plus begins


def test_an_outage_is_scored_at_its_end_and_only_where_it_is_whole(study, monkeypatch):
    batch = scene(3, 40, seed=2)
    present = batch.present.clone()
    present[2, 25:] = False
    batch = replace(batch, present=present)
    case = study._case("town", 10, batch, np.array([10, 12, 10]), (10, 20), {d: d for d in batch.drive})
    monkeypatch.setattr(study, "compile_filter", lambda estimator, *_: _Plain(estimator))
    filters = {"mbkf15": build_filter("mbkf15", IMU), "plus": build_filter("mbkf21", IMU)}
    rows = study.score(case, filters)
    assert [(r.length_s, len(r.groups)) for r in rows] == [(10, 3), (20, 2)]
    with torch.inference_mode():
        p = _Plain(filters["mbkf15"]).integrate(case.batch).posterior.p_n
    expected = float((p - case.batch.truth.p_n)[1, 21, :2].norm())
    assert rows[0].errors["mbkf15"][1] == pytest.approx(expected)
    line = study.markdown(rows)[2]
    assert line.startswith("| town | 10 | 10 | 3 (3) |") and "**" in line
    assert study.pooled(rows)[0].startswith("| over all rows | mbkf15 | plus |")


class _Plain:
    def __init__(self, estimator):
        self.estimator = estimator

    def integrate(self, batch):
        from dlkf.filters.integration import integrate

        return integrate(batch, self.estimator)
