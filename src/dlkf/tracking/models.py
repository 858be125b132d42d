"""Resolution of ``model=``: a name, folder, run id, registered model or class to a filter."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from inspect import signature
from pathlib import Path
from typing import Any

from dlkf.base.classes import find_class
from dlkf.base.documents import read_yaml
from dlkf.base.errors import InputError, did_you_mean
from dlkf.base.own_code import find_missing_modules
from dlkf.filters.build import OWN_SOURCE, build_filter, describe_filters, filter_names, is_filter
from dlkf.filters.saved import CONFIG, WEIGHTS, load_filter
from dlkf.filters.shipped import KNOWN_IMU, build_plus, shipped_folder
from dlkf.filters.smoother import Filter, run_smoother
from dlkf.filters.tuning import Prior, Tuning
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.tracking.runs import RUN_ID

NETWORKS = ("dlkf", "dlkf_kalman", "dlkf_literal")  # of conf/filter, which dlkf train trains
BEST = "best"  # folder of the weights that a training keeps


def resolve_model(
    spec: str,
    imu: ImuSpec,
    tracking_uri: str | None = None,
    *,
    tuning: Tuning | None = None,
    prior: Prior | None = None,
) -> Filter:
    """A filter by name, from a folder with weights and config, an MLflow run id, ``models:/name@alias``, or a class of
    one's own, ``module:Class``.

    ``imu`` and ``tuning`` belong to the model-based filters, ``imu`` to ``plus_imu`` as well, ``prior`` to those with
    ``_prior``. A network of one's own that is not on the path comes from the code logged with it. Raises InputError for
    anything else, listing what is known.
    """
    if not spec.strip():
        raise InputError("model= is empty; give a name such as plus, or a folder")
    if is_filter(spec):
        return build_filter(spec, imu, tuning=tuning, prior=prior)
    if OWN_SOURCE.fullmatch(spec):
        kind = find_class(spec, "model", ("begin", "step"))
        return kind(imu=imu) if "imu" in signature(kind).parameters else kind()
    if spec.endswith("_rts") and not Path(spec).expanduser().exists():
        causal = resolve_model(spec.removesuffix("_rts"), imu, tracking_uri, tuning=tuning, prior=prior)
        return run_smoother(causal, "rts")
    if spec == KNOWN_IMU:
        return build_plus(imu)
    if folder := shipped_folder(spec):
        return load_filter(folder)
    if RUN_ID.fullmatch(spec) or spec.startswith(("models:/", "runs:/")):
        from dlkf.tracking.registry import download_model  # MLflow takes seconds to import

        folder = download_model(spec, tracking_uri)
        find_missing_modules(read_yaml(folder / CONFIG), folder.parents[1] / "code")
        return load_filter(folder)
    folder = Path(spec).expanduser()
    if folder.is_dir():
        return load_filter(folder)
    if folder.is_file():
        raise InputError(f"model={spec} is a file; give the folder with {WEIGHTS} and {CONFIG} (pickles are not read)")
    if spec in NETWORKS:
        raise InputError(
            f"model={spec}: this network has no weights here, it is trained on drives of its IMU: dlkf train; then "
            "model=<the folder best that dlkf train names>, or model=plus, which needs no training"
        )
    if "/" in spec:
        raise InputError(f"model={spec}: no such folder; a model is a folder with {WEIGHTS} beside {CONFIG}")
    near = did_you_mean(spec, (*filter_names(), KNOWN_IMU))
    raise InputError(
        f"unknown model {spec!r}{near or '.'} A model is a filter (plus, {KNOWN_IMU}, {describe_filters()}), a folder, "
        "an MLflow run id, models:/name@alias or a class of your own, module:Class"
    )


def list_settings_taken(spec: str) -> tuple[str, ...]:
    """Which of ``imu`` and ``tuning`` have an effect on a model: a trained filter has its own noise."""
    if is_filter(spec) or OWN_SOURCE.fullmatch(spec):
        return ("imu", "tuning")
    return ("imu",) if spec.removesuffix("_rts") == KNOWN_IMU else ()


def takes_tuning(spec: str) -> bool:
    """Whether the noise of a model is set by ``imu`` and ``tuning``."""
    return "tuning" in list_settings_taken(spec)


def unused_settings(spec: str, given: Iterable[str]) -> str:
    """A line for settings that a model does not take, as they were given (``imu=consumer``); empty without any."""
    by_key = {word: word.partition("=")[0].partition(".")[0].removesuffix("_type") for word in given}
    unused = [word for word, key in by_key.items() if key not in list_settings_taken(spec)]
    if not unused:
        return ""
    known = spec == "plus" and "imu" in by_key.values()
    hint = f"; model={KNOWN_IMU} takes biases, scale factors and misalignments of an IMU from it" if known else ""
    what = f"{' '.join(unused)} {'has' if len(unused) == 1 else 'have'} no effect"
    return f"{short_name(spec)} has its own noise: {what} (for Kalman filters){hint}"


def model_folder(spec: str) -> Path:
    """Where weights and config of ``plus`` or of a model's folder lie; InputError where they are not or do not load."""
    folder = shipped_folder(spec) or Path(spec).expanduser()
    if not folder.is_dir():
        raise InputError(f"model={spec}: neither plus nor a folder with {WEIGHTS} and {CONFIG}")
    load_filter(folder)
    return folder


def resolve_models(
    specs: Sequence[str], imu: ImuSpec, tracking_uri: str | None = None, **options: Any
) -> dict[str, Filter]:
    """``{name in tables: filter}``, in the order of the specs; a repeated name gets a number."""
    models: dict[str, Filter] = {}
    for spec in specs:
        name = short_name(spec)
        if name in models:
            name = f"{name}#{sum(n == name or n.startswith(name + '#') for n in models) + 1}"
        models[name] = resolve_model(spec, imu, tracking_uri, **options)
    return models


def short_name(spec: str) -> str:
    """What a table calls a model: its name, its folder's, its registered one, or a run's first 8 digits.

    The folder ``best`` of a training is called after the training.
    """
    causal = spec.removesuffix("_rts")
    if is_filter(spec) or shipped_folder(causal) or causal == KNOWN_IMU:
        return spec
    if RUN_ID.fullmatch(spec):
        return spec[:8]
    if spec.startswith("models:/"):
        return spec.removeprefix("models:/")
    if OWN_SOURCE.fullmatch(spec):
        return spec.partition(":")[2]
    folder = Path(spec).expanduser().resolve()
    if folder.name == BEST:  # outputs/train/<name>/<hash>/best
        return f"{folder.parents[1].name}-{folder.parent.name}"
    return folder.name
