"""Outage schedules: which fixes go, and that none is scored that cannot be."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.data.masks import withhold_fixes
from dlkf.evaluation.metrics import outage_intervals
from dlkf.evaluation.outages import OutagePlan, describe_rounding, describe_unused, scorable_outages


def _windows(mask):
    return list(zip(*(a.tolist() for a in outage_intervals(mask.numpy()))))


def test_an_outage_withholds_the_fixes_after_its_start_up_to_its_end(cars):
    (mask,) = OutagePlan(first_s=20, duration_s=10).masks(cars)
    t = torch.arange(1, 61)
    assert all(t[row].tolist() == list(range(21, 31)) for row in mask)
    masked = withhold_fixes(cars, mask)
    assert not masked.available[mask].any() and masked.available[~mask].all() and cars.available.all()


def test_times_are_seconds_whatever_an_epoch_lasts(cars):
    """Sixty epochs of half a second: one outage fits to the last of them, the other leaves the segment."""
    half = replace(cars, dt=cars.dt / 2)
    (mask,) = OutagePlan(first_s=20, duration_s=10).masks(half)
    assert _windows(mask)[0] == (0, 40, 20)
    assert not OutagePlan(first_s=21, duration_s=10).masks(half)[0].any()


def test_times_that_are_no_whole_epochs_are_rounded_and_said(cars):
    """Outages are as the rounded plan has them, in every repetition; a plan of whole epochs stays as it is."""
    plan = OutagePlan(first_s=3.5, duration_s=[6.4, 6.4], every_s=17.3, offsets_s=[0.5])
    rounded = plan.in_whole_epochs(1.0)
    assert rounded == OutagePlan(first_s=3.0, duration_s=[6.0, 6.0], every_s=17.0, offsets_s=[0.0])
    assert describe_rounding(plan, 1.0) == (
        "rounded to whole epochs of 1 s: outage.first_s=3, outage.duration_s=[6,6], outage.every_s=17, "
        "outage.offsets_s=[0]"
    )
    (mask,) = rounded.masks(cars)
    assert _windows(mask)[:4] == [(0, 3, 6), (0, 20, 6), (0, 37, 6), (0, 54, 6)]
    assert OutagePlan(30.5, 21.4).in_whole_epochs(1.0) == OutagePlan(30.0, 21.0)
    assert OutagePlan(30.5, 0.2).in_whole_epochs(0.5) == OutagePlan(30.5, 0.5)
    for same in (plan, OutagePlan((10.0, 25.0), 30)):
        assert same.in_whole_epochs(0.1) == same and describe_rounding(same, 0.1) == ""
    assert describe_rounding(None, 1.0) == ""


def test_offsets_shift_the_whole_schedule_until_it_covers_the_drive(cars):
    masks = OutagePlan(first_s=5, duration_s=10, every_s=20, offsets_s=(0, 10)).masks(cars)
    assert _windows(masks[0])[:3] == [(0, 5, 10), (0, 25, 10), (0, 45, 10)]
    assert _windows(masks[1])[:2] == [(0, 15, 10), (0, 35, 10)]
    assert (masks[0] | masks[1])[:, 5:55].all()


def test_drawn_outages_repeat_with_the_seed_and_stay_in_their_bounds(cars):
    plan = OutagePlan(first_s=(10, 25), duration_s=(5, 30))
    first, again = (plan.masks(cars, seed=3)[0] for _ in range(2))
    assert torch.equal(first, again)
    found = _windows(first)
    assert len(found) == 6 and len({n for _, _, n in found}) > 2
    assert all(10 <= start <= 25 and 5 <= n <= 30 for _, start, n in found)


def test_outages_without_truth_or_without_a_fix_before_them_are_dropped(cars):
    truth, available, present = cars.truth_valid.clone(), cars.available.clone(), cars.present.clone()
    truth[0, 27] = False  # in the window
    available[1, 17:20] = False  # the three fixes before it
    available[2, 19] = False  # only the last one: the outage counts from the fix 1 s earlier
    present[3, 25:] = False  # the drive ends in the window
    batch = replace(cars, truth_valid=truth, available=available, present=present)
    (mask,) = OutagePlan(first_s=20, duration_s=10).masks(batch)
    assert mask.any(-1).tolist() == [False, False, True, False, True, True]


def test_one_bad_outage_of_several_leaves_the_others(cars):
    truth = cars.truth_valid.clone()
    truth[0, 30] = False
    mask = torch.zeros(6, 60, dtype=torch.bool)
    mask[:, 5:10] = mask[:, 25:35] = mask[:, 50:60] = True
    kept = scorable_outages(replace(cars, truth_valid=truth), mask)
    assert [w[1:] for w in _windows(kept) if w[0] == 0] == [(5, 5), (50, 10)]
    assert torch.equal(kept[1:], mask[1:])


@pytest.mark.parametrize(
    "settings",
    [
        {"duration_s": 0},
        {"duration_s": [30, 10]},
        {"first_s": -1},
        {"every_s": 60, "duration_s": 60},
        {"offsets_s": [-5]},
    ],
)
def test_impossible_schedules_are_refused(settings):
    with pytest.raises(InputError, match="outage"):
        OutagePlan(**settings)


def test_a_fix_close_before_is_counted_in_seconds(cars):
    """Two seconds are four epochs of half a second: a fix 2 s before is close enough, one 2.5 s before is not."""
    available = cars.available.clone()
    available[0, 17:20], available[1, 16:20] = False, False
    batch = replace(cars, dt=cars.dt / 2, available=available)
    (mask,) = OutagePlan(first_s=10, duration_s=5).masks(batch)
    assert mask.any(-1).tolist() == [True, False, True, True, True, True]


def test_drives_without_an_outage_are_named_with_the_reason():
    plan, mask = OutagePlan(first_s=(20, 60), duration_s=10), np.zeros((5, 40), bool)
    mask[1, 20:30] = True  # the second run of a drive has one
    ends = np.array([40.0, 40.0, 25.0, 40.0, 29.0])
    assert describe_unused(plan, mask, ends, ["a", "a", "b", "c", "d"]) == (
        "no outage in 3 of 4 drives: b, d too short for outage.first_s=20 + outage.duration_s=10 s; "
        "c without a fix at its start or valid truth throughout"
    )
    assert describe_unused(plan, mask[:2], ends[:2], ["a", "a"]) == ""
