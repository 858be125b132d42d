"""NEES and NIS of filters: ``python -m dlkf.consistency 'model=[mbkf15,plus]' imu=consumer drives=100``.

Simulates, for every filter, drives with the IMU errors that it models, and leaves table.md, consistency.png and
consistency.json in ``out``.
"""

from __future__ import annotations

import sys

from rich.console import Console

from dlkf.command import command
from dlkf.command.scored import ConsistencySettings
from dlkf.console import counting
from dlkf.data.masks import withhold
from dlkf.diagnosis.consistency import Normalised, consistency, consistency_table, states_of, write_consistency
from dlkf.diagnosis.matched_drives import matched_batch, matching
from dlkf.errors import InputError
from dlkf.evaluation.table import as_rich
from dlkf.files import vacant
from dlkf.filters.model_based import has_covariance
from dlkf.models import resolve_model, resolve_models


@command("consistency", ConsistencySettings)
def main(told: ConsistencySettings) -> None:
    """Simulate, run, compare, write, print."""
    vacant(told.out, overwrite=told.overwrite)
    settings, preset, plan = told.matched, told.spec, told.outage
    asked = resolve_models(told.models, preset, tuning=told.tuning)
    states = {name: states_of(name, model) for name, model in asked.items()}
    results: dict[str, Normalised] = {}
    outage = None
    for name, model in zip(asked, told.models, strict=True):
        spec = matching(preset, states[name])
        with counting(f"Simulating for {name}") as progress:
            batch, matrices = matched_batch(settings, spec, progress)
        if plan is not None:
            mask = plan.masks(batch)[0]
            if not bool(mask.any()):
                raise InputError(f"no outage fits into {settings.minutes:g} minutes; see outage.* and minutes")
            batch, outage = withhold(batch, mask), mask[0].numpy()
        with counting(f"Running {name}") as progress:
            estimator = resolve_model(model, spec, tuning=told.tuning)
            assert has_covariance(estimator)  # as ``states_of`` has seen
            results[name] = consistency(estimator, batch, matrices, progress)
    title = f"{settings.drives} simulated drives of {settings.minutes:g} min, IMU {preset.name}, errors as modelled"
    table = consistency_table(results, told.settle_s, title)
    write_consistency(told.out, results, table, outage)
    Console(width=None if sys.stdout.isatty() else 110).print(as_rich(table))
    print(f"Report: {told.out}/consistency.png, table.md")


if __name__ == "__main__":
    main()
