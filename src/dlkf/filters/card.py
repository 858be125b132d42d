"""Model card of a learned filter, stored beside its weights, and what it implies for scoring (paper.md 4.8)."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dlkf.base.documents import read_yaml
from dlkf.base.errors import InputError, count_calls
from dlkf.data.kinds import drive_imus
from dlkf.data.tables import DriveRow
from dlkf.filters.tuning import Tuning

CARD, CARD_TEXT = "card.yaml", "card.md"  # for programs, for people
TRAINED = "trained or chosen"
LISTS = ("trained_on", "chosen_on", "imus")  # of names, on a card


def read_card(folder: Path) -> dict[str, Any]:
    """The card in a model's folder; empty where there is none."""
    path = folder / CARD
    if not path.is_file():
        return {}
    values = read_yaml(path)
    if not isinstance(values, dict):
        return {}
    for key in LISTS:
        names = values.get(key) or []
        if not isinstance(names, list) or not all(isinstance(name, (str, int, float)) for name in names):
            raise InputError(f"{path}: {key} must be a list of names; replace it by the card.yaml that training wrote")
    datasets = values.get("datasets") or {}
    if not isinstance(datasets, dict) or not all(isinstance(x, str) for pair in datasets.items() for x in pair):
        raise InputError(
            f"{path}: datasets must be names with their digests; replace it by the card.yaml that training wrote"
        )
    return values


def find_seen_recordings(card: Mapping[str, Any], dataset: str, digest: str, groups: Iterable[str]) -> set[str]:
    """Recordings among ``groups`` that a model was trained or chosen on.

    They count where the dataset's name or its digest is one of the card's: recordings of other datasets may bear
    the same names.
    """
    known = card.get("datasets") or {}
    if dataset not in known and digest not in known.values():
        return set()
    return set(groups) & {*(card.get("trained_on") or ()), *(card.get("chosen_on") or ())}


def describe_unseen_imus(cards: Mapping[str, Mapping[str, Any]], imus: Iterable[str]) -> list[str]:
    """A line for each model that works with its training IMUs alone, where ``imus`` are others.

    ``cards`` by the models' names; none for a card without ``imus``.
    """
    lines = []
    for name, card in cards.items():
        known = set(card.get("imus") or ())
        if known and (unmet := sorted(set(imus) - known)):
            lines.append(
                f"{name} was trained on the IMU {', '.join(sorted(known))}; for {', '.join(unmet)} its accuracy "
                "is not validated"
            )
    return lines


class LowSampleRateWarning(UserWarning):
    """The warning of :func:`describe_slow_drives`, for a filter that is used from Python."""


def describe_slow_drives(
    models: Mapping[str, object], rates: Iterable[float], having: str = "these drives have"
) -> list[str]:
    """A line for each model that uses frequency bands of the samples, where ``rates`` [Hz] has one too slow.

    ``models`` by their names; one without ``least_rate_hz`` takes any rate. A clock a tenth slow is as good.
    """
    lines, met = [], list(rates)
    for name, model in models.items():
        least = getattr(model, "least_rate_hz", 0.0)
        if slow := sorted({float(f"{rate:.2g}") for rate in met if rate < 0.9 * least}):
            have = f"{slow[0]:g}" if len(slow) == 1 else f"{slow[0]:g} to {slow[-1]:g}"
            lines.append(
                f"{name} needs samples at {least:g} Hz or more for its full accuracy and {having} {have} Hz: "
                "expect larger errors in outages"
            )
    return lines


def warn_slow_drives(model: object, rate_hz: float) -> bool:
    """Whether a stream is too slow for a filter, which is a warning (:class:`LowSampleRateWarning`)."""
    lines = describe_slow_drives({"the filter": model}, [rate_hz], "this stream has")
    for line in lines:
        warnings.warn(line, LowSampleRateWarning, stacklevel=count_calls())
    return bool(lines)


def domain_warnings(
    models: Mapping[str, object], dataset: str | Path, rates: Mapping[str, float], preset: str, rate_hz: int | float
) -> list[str]:
    """Lines for models on drives that they were not made for, by IMU and by rate of the samples (``rates``: of these
    drives).

    The IMU is ``preset`` where the dataset names none; samples brought to ``rate_hz`` are as fast as they were at most.
    """
    imus = drive_imus(dataset)
    cards = {name: getattr(model, "card", {}) for name, model in models.items()}
    unmet = describe_unseen_imus(cards, {imus.get(drive, preset) for drive in rates})
    return unmet + describe_slow_drives(models, [float(min(rate_hz, rate)) for rate in rates.values()])


def select_scored_drives(
    cards: Mapping[str, Mapping[str, Any]], drives: Sequence[DriveRow], dataset: str, digest: str, *, leave_out: bool
) -> tuple[list[DriveRow], list[str]]:
    """The drives of a dataset to score models on, and a line for each model trained on some of their recordings.

    ``cards`` by the models' names; ``leave_out`` takes those recordings out, for all models alike. InputError where
    none is left.
    """
    groups = {d.group for d in drives}
    seen = {name: find_seen_recordings(card, dataset, digest, groups) for name, card in cards.items()}
    if leave_out:
        kept = [d for d in drives if d.group not in set().union(*seen.values())]
        if not kept:
            raise InputError(
                "unseen=true leaves no drive: every recording was in the training of a model or its tuning"
            )
        return kept, []
    return list(drives), [
        describe_seen_recordings(
            name, len(which), len(groups), "unseen=true leaves them out", cards[name].get("how", TRAINED)
        )
        for name, which in seen.items()
        if which
    ]


def card_of_tuning(models: Iterable[str], tuning: Tuning) -> dict[str, dict[str, Any]]:
    """What the card of a learned filter has, of the noise of these Kalman filters; empty where nothing is known."""
    names, fit = ", ".join(models), tuning.fitted_on
    if not names or fit is None:
        return {}
    trained = {"trained_on": fit.recordings, "datasets": {fit.dataset: fit.digest}}
    return {f"the tuning of {names}": trained | {"how": "fitted"}}


def describe_seen_recordings(name: str, seen: int, of: int, remedy: str, how: str = TRAINED) -> str:
    """A line for a model that is scored on recordings of its training."""
    return f"{name} was {how} on {seen} of these {of} recordings, so its errors are too small; {remedy}"
