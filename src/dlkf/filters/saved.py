"""Learned filters on disk: ``weights.safetensors`` beside a ``config.yaml`` whose ``kind`` names the filter."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from dlkf.base.documents import read_yaml
from dlkf.base.errors import InputError
from dlkf.data.resampling import check_rate, usual_rate
from dlkf.filters.card import CARD, read_card
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.learned_kalman import LearnedKalmanConfig, LearnedKalmanFilter
from dlkf.filters.plus import PlusConfig, PlusFilter

WEIGHTS, CONFIG = "weights.safetensors", "config.yaml"
LearnedSettings = LearnedConfig | PlusConfig
Learned = LearnedFilter | PlusFilter
KINDS: Mapping[str, type[LearnedConfig] | type[PlusConfig]] = {
    "dlkf": LearnedConfig, "dlkf_kalman": LearnedKalmanConfig, "plus": PlusConfig,
}  # fmt: skip


def parse_learned_settings(values: Mapping[str, Any]) -> LearnedSettings:
    """Of a learned filter from plain values; InputError for an unknown ``kind`` or setting."""
    kind = values.get("kind", "dlkf")
    if not isinstance(kind, str) or kind not in KINDS:
        raise InputError(f"model.kind is {kind!r}; choose one of {', '.join(KINDS)}")
    return KINDS[kind].from_mapping(values)


def build_learned_filter(settings: LearnedSettings) -> Learned:
    """A filter with fresh weights."""
    if isinstance(settings, PlusConfig):
        return PlusFilter(settings)
    return LearnedKalmanFilter(settings) if isinstance(settings, LearnedKalmanConfig) else LearnedFilter(settings)


def save_filter(model: Learned, folder: Path | str, card: Mapping[str, Any] | None = None) -> None:
    """Write ``weights.safetensors`` and ``config.yaml``; what it was made of goes beside, as ``card.yaml``."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    save_file({k: v.detach().cpu().contiguous() for k, v in model.state_dict().items()}, folder / WEIGHTS)
    (folder / CONFIG).write_text(yaml.safe_dump(model.config.as_dict(), sort_keys=False))
    if card is not None:
        (folder / CARD).write_text(yaml.safe_dump(dict(card), sort_keys=False, allow_unicode=True), encoding="utf-8")


def choose_grid(
    models: Iterable[Any],
    rate_hz: int | float | None = None,
    epoch_s: int | float | None = None,
    usual_epoch_s: int | float = 1.0,
    rates: Iterable[float] = (),
) -> dict[str, Any]:
    """``rate_hz`` and ``epoch_s``: as given, else what a trained filter was trained on, else the usual for logs with
    ``rates`` samples a second (:func:`dlkf.data.resampling.usual_rate`) and ``usual_epoch_s``.

    Raises InputError where one of them is not above 0, or beyond what there is.
    """
    configs: list[Any] = [getattr(m, "config", None) for m in models]
    check_rate(rate_hz, epoch_s)
    usual = usual_rate(rates, usual_epoch_s if epoch_s is None else epoch_s), usual_epoch_s
    own = next(((c.rate_hz, c.epoch_s) for c in configs if hasattr(c, "rate_hz")), usual)
    return {"rate_hz": own[0] if rate_hz is None else rate_hz, "epoch_s": own[1] if epoch_s is None else epoch_s}


def load_filter(folder: Path | str) -> Learned:
    """Read a saved filter, ready to run. Raises InputError for missing, foreign or unfitting files."""
    folder = Path(folder)
    for name in (CONFIG, WEIGHTS):
        if not (folder / name).is_file():
            raise InputError(f"model folder {folder} has no {name}; a model is {WEIGHTS} beside {CONFIG}")
    values = read_yaml(folder / CONFIG)
    if not isinstance(values, dict):
        raise InputError(f"{folder / CONFIG} holds no settings; expected the config.yaml that training wrote")
    model = build_learned_filter(parse_learned_settings(values))
    try:
        weights = load_file(folder / WEIGHTS)
    except (SafetensorError, OSError):
        raise InputError(
            f"{folder / WEIGHTS} is not a safetensors file (a pickle is never loaded); export the model again"
        ) from None
    expected = model.state_dict()
    for name in sorted(set(expected) | set(weights)):
        if name not in weights or name not in expected or weights[name].shape != expected[name].shape:
            have = tuple(weights[name].shape) if name in weights else "nothing"
            want = tuple(expected[name].shape) if name in expected else "nothing"
            raise InputError(
                f"{folder / WEIGHTS} does not fit {CONFIG}: {name} is {have} in the file, {want} in the config; "
                "weights of other settings, or of another version of dlkf: train them with this one"
            )
        if weights[name].is_floating_point() != expected[name].is_floating_point():
            kinds = f"{weights[name].dtype} in the file, {expected[name].dtype} in the filter"
            raise InputError(f"{folder / WEIGHTS}: {name} is {kinds}; export the model again")
        if weights[name].is_floating_point() and not bool(weights[name].isfinite().all()):
            raise InputError(f"{folder / WEIGHTS}: {name} holds values that are not finite; export the model again")
    model.load_state_dict(weights)
    model.card = read_card(folder)
    return model.eval()
