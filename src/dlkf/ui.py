"""MLflow's pages over the runs of this folder, opened where runs are: ``dlkf ui [port=5000]``.

MLflow opens on pages for language models, empty here, and so does a click in its list of experiments; the links
that are printed go to the runs.
"""

from __future__ import annotations

import os
import sys

from dlkf.base.errors import InputError
from dlkf.tracking.runs import open_client, store_missing, tracking_uri

HELP = """MLflow's pages over the runs of this folder, until Ctrl-C:
  python -m dlkf.ui
  python -m dlkf.ui port=5001

Keys (key=value):
  port=5000
  host=127.0.0.1  0.0.0.0: other machines, too, without a login
  uri=null  null: mlflow.db here; or a store, as in tracking.uri"""
PAGE = "/#/experiments{of}?workflowType=machine_learning"


def main() -> None:
    """Start the server, print the links, stay until Ctrl-C."""
    if {"--help", "-h"} & set(sys.argv[1:]):
        print(HELP)
        return
    split = (argument.partition("=") for argument in sys.argv[1:])
    given = {key: value for key, _, value in split}
    try:
        if unknown := sorted(set(given) - {"port", "host", "uri"}):
            raise InputError(f"ui: unknown key {unknown[0]}; known are port, host, uri")
        if not given.get("port", "5000").isdigit():
            raise InputError(f"port={given['port']}: must be a number")
        uri = tracking_uri(given.get("uri"))
        if store_missing(uri):
            raise InputError(f"there is no MLflow store at {uri.removeprefix('sqlite:///')}; see tracking.uri")
        host, port = given.get("host", "127.0.0.1"), given.get("port", "5000")
        said = links(uri, f"http://{host}:{port}")
    except InputError as error:
        print(f"dlkf: error: {error}", file=sys.stderr)
        sys.exit(2)
    print("\n".join(said), flush=True)
    environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
    command = [sys.executable, "-m", "mlflow", "ui", "--workers", "1", "--host", host, "--port", port]
    os.execve(command[0], [*command, "--backend-store-uri", uri], environment)  # in place: signals reach the server


def links(uri: str, address: str) -> list[str]:
    """A line for every experiment with runs, the latest first, with the page that has them."""
    client = open_client(uri)
    kept = [e for e in client.search_experiments() if client.search_runs([e.experiment_id], max_results=1)]
    latest = sorted(kept, key=lambda e: e.last_update_time or 0, reverse=True)
    pages = [(f"Runs of {e.name}", f"/{e.experiment_id}/runs") for e in latest] or [("Runs", "")]
    return [f"{name}: {address}{PAGE.format(of=of)}" for name, of in pages]


if __name__ == "__main__":
    main()
