"""A run's model into the registry: ``python -m dlkf.register run=<id> name=town alias=champion``.

Of a grid search's parent run, the point that validated best.
"""

from __future__ import annotations

from omegaconf import DictConfig

from dlkf.command import command
from dlkf.errors import InputError
from dlkf.tracking.comparison import best_of
from dlkf.tracking.registry import check_registration, registered
from dlkf.tracking.runs import client_of, reachable, run_exists, store_missing, tracking_uri


@command("register")
def main(cfg: DictConfig) -> None:
    """Look, choose, register, print."""
    run_id, uri = str(cfg.run), tracking_uri(cfg.tracking.uri)
    check_registration(cfg.name, cfg.alias)
    if store_missing(uri):
        raise InputError(f"there is no MLflow store at {uri.removeprefix('sqlite:///')}; give tracking.uri=…")
    with reachable(uri):
        client = client_of(uri)
        if not run_exists(client, run_id):
            raise InputError(f"run={run_id}: {uri} has no such run")
        best = best_of(client, run_id)
        number = registered(client, best.info.run_id, cfg.name, cfg.alias)
    alias = f", models:/{cfg.name}@{cfg.alias}" if cfg.alias else ""
    print(f"{best.info.run_name}: models:/{cfg.name}/{number}{alias}")


if __name__ == "__main__":
    main()
