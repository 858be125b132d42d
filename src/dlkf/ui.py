"""MLflow's pages over the runs of this folder, opened where runs are: ``dlkf ui [port=5000]``.

MLflow opens on pages for language models, empty here; the link that is printed goes to the trainings.
"""

from __future__ import annotations

import os
import subprocess
import sys

from dlkf.errors import InputError
from dlkf.tracking.runs import store_missing, tracking_uri

PAGE = "/#/experiments?workflowType=machine_learning"


def main() -> None:
    """Start the server, print the link, stay until Ctrl-C."""
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
    except InputError as error:
        print(f"dlkf: error: {error}", file=sys.stderr)
        sys.exit(2)
    host, port = given.get("host", "127.0.0.1"), given.get("port", "5000")
    print(f"Runs: http://{host}:{port}{PAGE}", flush=True)
    environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
    command = [sys.executable, "-m", "mlflow", "ui", "--workers", "1", "--host", host, "--port", port]
    sys.exit(subprocess.run([*command, "--backend-store-uri", uri], env=environment).returncode)


if __name__ == "__main__":
    main()
