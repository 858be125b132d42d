"""A model into the registry: ``python -m dlkf.register run=<id> name=town alias=champion``.

Of a grid search's parent run, the point that validated best; with ``model=plus``, or the folder of a model, that one.
"""

from __future__ import annotations

from dlkf.base.errors import InputError
from dlkf.command import command
from dlkf.command.settings import RegisterSettings
from dlkf.filters.card import CARD_TEXT
from dlkf.tracking.comparison import choose_best
from dlkf.tracking.models import model_folder
from dlkf.tracking.registry import check_registration, log_model, register_model
from dlkf.tracking.runs import check_store, open_client, reachable, run_exists, start_run, store_missing, tracking_uri


@command("register", RegisterSettings)
def main(settings: RegisterSettings) -> None:
    """Look, choose, register, print."""
    name, alias = settings.name, settings.alias
    if (settings.run is None) == (settings.model is None):
        raise InputError("give run=<id of a training>, or model=plus or a folder: one of the two")
    uri = tracking_uri(settings.tracking.uri)
    check_registration(name, alias)
    if settings.model is not None:
        folder = model_folder(settings.model)
        with start_run(uri, "models", settings.model) as run:
            if (card := folder / CARD_TEXT).is_file():
                run.note(card.read_text(encoding="utf-8"))
            log_model(run, folder)
        run_id = run.id
    else:
        run_id = str(settings.run)
        if store_missing(uri):
            raise InputError(f"there is no MLflow store at {uri.removeprefix('sqlite:///')}; give tracking.uri=…")
        check_store(uri)
    with reachable(uri):
        client = open_client(uri)
        if not run_exists(client, run_id):
            raise InputError(f"run={run_id}: {uri} has no such run")
        best = choose_best(client, run_id)
        number = register_model(client, best.info.run_id, name, alias)
    also = f", models:/{name}@{alias}" if alias else ""
    print(f"{best.info.run_name}: models:/{name}/{number}{also}")


if __name__ == "__main__":
    main()
