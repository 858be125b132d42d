"""A run's model into the registry: ``python -m dlkf.register run=<id> name=town alias=champion``.

Of a grid search's parent run, the point that validated best.
"""

from __future__ import annotations

from dlkf.command import command
from dlkf.command.settings import RegisterSettings
from dlkf.errors import InputError
from dlkf.tracking.comparison import best_of
from dlkf.tracking.registry import check_registration, registered
from dlkf.tracking.runs import check_store, client_of, reachable, run_exists, store_missing, tracking_uri


@command("register", RegisterSettings)
def main(told: RegisterSettings) -> None:
    """Look, choose, register, print."""
    run_id, name, alias = told.run, told.name, told.alias
    uri = tracking_uri(told.tracking.uri)
    check_registration(name, alias)
    if store_missing(uri):
        raise InputError(f"there is no MLflow store at {uri.removeprefix('sqlite:///')}; give tracking.uri=…")
    check_store(uri)
    with reachable(uri):
        client = client_of(uri)
        if not run_exists(client, run_id):
            raise InputError(f"run={run_id}: {uri} has no such run")
        best = best_of(client, run_id)
        number = registered(client, best.info.run_id, name, alias)
    also = f", models:/{name}@{alias}" if alias else ""
    print(f"{best.info.run_name}: models:/{name}/{number}{also}")


if __name__ == "__main__":
    main()
