"""NEES and NIS of filters: ``python -m dlkf.consistency 'model=[mbkf15,plus]' imu=consumer drives=100``.

Simulates, for every filter, drives with the IMU errors that it models, and leaves table.md, consistency.png and
consistency.json in ``out``.
"""

from __future__ import annotations

from dlkf.base.console import make_console, show_progress
from dlkf.base.errors import InputError
from dlkf.base.files import require_empty
from dlkf.command import command
from dlkf.command.simulated import ConsistencySettings
from dlkf.data.masks import withhold_fixes
from dlkf.diagnosis.consistency import (
    NormalisedSquares,
    consistency_table,
    find_states,
    measure_consistency,
    write_consistency,
)
from dlkf.diagnosis.matched_drives import make_matched_batch, make_matched_drives
from dlkf.evaluation.table import as_rich
from dlkf.filters.model_based import has_covariance
from dlkf.tracking.models import resolve_model, resolve_models


@command("consistency", ConsistencySettings)
def main(settings: ConsistencySettings) -> None:
    """Simulate, run, compare, write, print."""
    require_empty(settings.out, overwrite=settings.overwrite)
    matched, preset, plan = settings.matched, settings.spec, settings.outage
    asked = resolve_models(settings.models, preset, tuning=settings.tuning)
    states = {name: find_states(name, model) for name, model in asked.items()}
    results: dict[str, NormalisedSquares] = {}
    outage = None
    for name, model in zip(asked, settings.models, strict=True):
        spec = make_matched_drives(preset, states[name])
        with show_progress(f"Simulating for {name}") as progress:
            batch, matrices = make_matched_batch(matched, spec, progress)
        if plan is not None:
            mask = plan.masks(batch)[0]
            if not bool(mask.any()):
                raise InputError(f"no outage fits into {matched.minutes:g} minutes; see outage.* and minutes")
            batch, outage = withhold_fixes(batch, mask), (mask.double().mean(0) > 0.5).numpy()
        with show_progress(f"Running {name}") as progress:
            estimator = resolve_model(model, spec, tuning=settings.tuning)
            assert has_covariance(estimator)  # as ``find_states`` has seen
            results[name] = measure_consistency(estimator, batch, matrices, progress)
    title = f"{matched.drives} simulated drives of {matched.minutes:g} min, IMU {preset.name}, errors as modelled"
    table = consistency_table(results, settings.settle_s, title)
    write_consistency(settings.out, results, table, outage)
    make_console().print(as_rich(table))
    print(f"Report: {settings.out}/consistency.png, table.md")


if __name__ == "__main__":
    main()
