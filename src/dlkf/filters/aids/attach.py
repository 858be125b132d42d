"""Which sensors a filter takes: those of its name, and of a filter with vehicle constraints those of the drive."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import is_dataclass, replace
from typing import Any

from dlkf.base.errors import InputError
from dlkf.data.aid_tables import AidTable, standard_tables
from dlkf.filters.aids.heading import DualAntennaHeading
from dlkf.filters.aids.height import Barometer
from dlkf.filters.aids.wheel_speed import WheelSpeed
from dlkf.filters.constraints import CarConstraints
from dlkf.filters.g_sensitivity import GSensitivity
from dlkf.filters.model_based import Mbkf
from dlkf.filters.receiver import Receiver
from dlkf.filters.smoother import SmoothedSolution
from dlkf.filters.sources import Source
from dlkf.filters.vibration_speed import VibrationSpeed
from dlkf.navigation.state import ErrorStates

SENSORS: Mapping[str, type[Source]] = {"speed": WheelSpeed, "heading": DualAntennaHeading, "baro": Barometer}
OTHERS: Mapping[str, type[Source]] = {
    "vibration_speed": VibrationSpeed, "receiver": Receiver, "g_sensitivity": GSensitivity,
}  # fmt: skip
SOURCES: Mapping[str, type[Source]] = {**SENSORS, **OTHERS}  # that stand behind a plus


def add_sources(kalman: Mbkf, kinds: Sequence[type[Source]]) -> Mbkf:
    """The filter with further sources, and their error states behind its own.

    Sensors stand in front of the constraints, which depend on whether a wheel turns; what has no table, behind.
    """
    kinds = [kind for kind in kinds if not any(type(source) is kind for source in kalman.sources)]
    if not kinds:
        return kalman
    names = tuple(name for kind in kinds for name in getattr(kind, "parameters", {}))
    states = replace(kalman.states, others=(*kalman.states.others, *names))
    made: list[Any] = [kind(kalman.imu, kalman.tuning, states) for kind in kinds]  # type: ignore[call-arg]
    own = [_set_states(source, states) for source in kalman.sources]
    sensors = [source for source in made if hasattr(source, "table")]
    others = [source for source in made if not hasattr(source, "table")]
    return replace(kalman, states=states, sources=(*sensors, *own, *others))


def with_aids(model: Any, tables: Iterable[AidTable | str]) -> Any:
    """A filter that also takes these sensors of the contract, tables or names, if it has vehicle constraints
    (``_nhc``, ``_car``, plus).

    Others are given back as they are, and so is a filter that has all of them.
    """
    tables = [standard_tables([x])[0] if isinstance(x, str) else x for x in tables]
    if isinstance(model, SmoothedSolution):
        return SmoothedSolution(with_aids(model.filter, tables))
    inner = getattr(model, "kalman", model)
    if not isinstance(inner, Mbkf) or not any(isinstance(source, CarConstraints) for source in inner.sources):
        return model
    kalman = add_sources(inner, [SENSORS[table.name] for table in tables])
    if inner is model:
        return kalman
    other = copy.copy(model)
    other.kalman = kalman
    return other


def refuse_left_out(models: Mapping[str, Any], tables: Iterable[AidTable]) -> None:
    """InputError where the sensors that were chosen leave out one that a filter has by its name."""
    tables = tuple(tables)
    for name, model in models.items():
        left_out = [x.name for x in find_tables(model) if x.name in SENSORS and x not in tables]
        if left_out:
            raise InputError(
                f"aids=[{','.join(x.name for x in tables)}] leaves out {left_out[0]}, which model={name} takes by its "
                f"name; take +{left_out[0]} off the name, or put it into aids"
            )


def add_chosen_aids(name: str, model: Any, aids: Sequence[str] | str) -> Any:
    """The filter ``name`` with the sensors that were chosen; InputError where it takes one of them not, or another."""
    chosen = standard_tables([aids] if isinstance(aids, str) else aids)
    refuse_left_out({name: model}, chosen)
    model = with_aids(model, chosen)
    if unused := [table.name for table in chosen if table not in find_tables(model)]:
        raise InputError(
            f"aids: model={name} has no vehicle constraints and takes no {unused[0]}; a Kalman filter takes it by its "
            f"name, model=mbkf15+{unused[0]}"
        )
    return model


def describe_aids(models: Mapping[str, Any], tables: Iterable[AidTable]) -> list[str]:
    """A line for each sensor of a dataset: which filters take it, and which do not."""
    lines = []
    for table in tables:
        takes = [name for name, model in models.items() if table in find_tables(model)]
        others = [n for n in models if n not in takes and hasattr(find_kalman(models[n]), "sources")]
        never = [name for name in models if name not in takes and name not in others]
        said = f"{table.name}: used by {', '.join(takes)}" if takes else f"{table.name}: used by no filter here"
        if others:
            said += f"; {', '.join(others)} {'takes' if len(others) == 1 else 'take'} it as {others[0]}+{table.name}"
        if never and takes:
            said += f"; not by {', '.join(never)}"
        lines.append(said)
    return lines


def find_kalman(model: Any) -> Any:
    """The Kalman filter in a smoothed, compiled or learned one, if it has one."""
    inner = model.filter if isinstance(model, SmoothedSolution) else getattr(model, "estimator", model)
    return getattr(inner, "kalman", inner)


def find_tables(model: Any) -> tuple[AidTable, ...]:
    """The tables that a filter's sources use, in the order of its sources."""
    tables = [getattr(source, "table", None) for source in getattr(find_kalman(model), "sources", ())]
    return tuple(table for table in tables if table is not None)


def aid_columns(model: Any) -> tuple[str, ...]:
    """A filter's output about its sensors, in the order of :attr:`dlkf.filters.integration.Correction.aids`:
    innovation, its 1σ and whether it counted of each, with what a source without a table adds behind its own, then the
    estimates of the sensors' parameters, then their 1σ."""
    inner = find_kalman(model)
    states: ErrorStates = getattr(inner, "states", ErrorStates())
    said: list[str] = []
    for source in getattr(inner, "sources", ()):
        if (table := getattr(source, "table", None)) is not None:
            said += (f"{table.name}_{x}" for x in ("innovation", "innovation_std", "used"))
        else:
            said += getattr(source, "columns", ())
    return (*said, *states.others, *(f"std_{name}" for name in states.others))


def unmeasured_value(column: str) -> float | None:
    """What one of :func:`aid_columns` says of an interval without a measurement; None: an estimate, which stays."""
    if column.endswith(("_innovation", "_innovation_std")):
        return math.nan
    return 0.0 if column.endswith("_used") else None


def _set_states(source: Any, states: ErrorStates) -> Any:
    """A source for a filter with further states."""
    if is_dataclass(source) and not isinstance(source, type):
        return replace(source, states=states)
    other: Any = copy.copy(source)
    other.states = states
    return other
