"""Models in MLflow: logged as code with weights (no pickle), registered by name, fetched for evaluation."""

from __future__ import annotations

import atexit
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import dlkf
from dlkf.base.config import config_dir
from dlkf.base.documents import read_yaml
from dlkf.base.errors import InputError, first_line
from dlkf.base.own_code import copy_modules, find_own_modules
from dlkf.data.rows import GNSS_COLUMNS, IMU_COLUMNS, example_drive
from dlkf.filters.saved import CONFIG, WEIGHTS
from dlkf.running.solution import COLUMNS
from dlkf.tracking.endings import use_store
from dlkf.tracking.runs import (
    NOTE_TAG,
    PARENT_TAG,
    RUN_ID,
    TrackedRun,
    mlflow_module,
    open_client,
    reachable,
    run_exists,
    store_missing,
    tracking_uri,
)

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

NAME = "model"
NO_STEP = -1  # at a step of training MLflow would give the model that step's losses and CPU load as its metrics
CODE = Path(__file__).with_name("pyfunc_model.py")
REQUIRED = ("mlflow", "torch", "numpy", "scipy", "pandas", "pyarrow", "safetensors", "pyyaml", "pymap3d", "jaxtyping")
SPEC = re.compile(r"(?P<name>[^/:@]+)(?:@(?P<alias>[^/@]+)|/(?P<version>\d+|latest))?")


def log_model(
    run: TrackedRun,
    folder: Path | str,
    *,
    register: str | None = None,
    alias: str | None = None,
    metrics: Mapping[str, float] | None = None,
) -> str:
    """Log a folder of ``weights.safetensors`` and ``config.yaml`` as a model of the active run.

    Stored are :mod:`dlkf.tracking.pyfunc_model`, this package's source, that of a user's own network and pinned
    requirements. ``register`` makes it a version in the model registry, ``alias`` points there (an alias alone
    registers under the experiment's name). ``metrics`` stand beside the model in the UI. Returns ``models:/<id>``.
    """
    mlflow = mlflow_module()
    client = run.client
    if alias and not register:
        register = client.get_experiment(client.get_run(run.id).info.experiment_id).name
    check_registration(register, alias)
    own = find_own_modules(read_yaml(Path(folder) / CONFIG))
    with _without_bytecode(), tempfile.TemporaryDirectory() as beside:
        code = [_copy_package(Path(beside)), *copy_modules(own, Path(beside, "own"))]
        info = mlflow.pyfunc.log_model(
            name=NAME,
            python_model=str(CODE),
            artifacts={"filter": str(folder)},
            code_paths=[str(path) for path in code],
            pip_requirements=pin_requirements(),
            signature=signature(),
            input_example=example_drive(),
            step=NO_STEP,
        )
    _log_model_metrics(run, info.model_id, metrics or {})
    if register:
        register_model(client, run.id, register, alias)
    return info.model_uri


def _copy_package(folder: Path) -> Path:
    """This package with ``conf/`` in it, as a wheel has it."""
    package = folder / "dlkf"
    shutil.copytree(Path(dlkf.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    if not (package / "conf").is_dir():
        shutil.copytree(config_dir(), package / "conf")
    return package


@contextmanager
def _without_bytecode() -> Iterator[None]:
    """MLflow imports the model's code from the folder that it is about to log, where Python would leave a cache."""
    before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        yield
    finally:
        sys.dont_write_bytecode = before


def signature():
    """What the model takes and gives: a table of a drive, or of dataset folders; the solution."""
    from mlflow.models import ModelSignature
    from mlflow.types import ColSpec, DataType, ParamSchema, ParamSpec, Schema

    numbers = [ColSpec(DataType.double, c, required=False) for c in ("t", *IMU_COLUMNS, *GNSS_COLUMNS)]
    words = [ColSpec(DataType.string, c, required=False) for c in ("drive", "dataset")]
    solved = [ColSpec(DataType.string, "drive"), *(ColSpec(DataType.double, c) for c in COLUMNS)]
    arm = [ParamSpec(f"lever_arm_{a}_m", DataType.double, 0.0) for a in "xyz"]
    solution = Schema([*solved, ColSpec(DataType.boolean, "gnss_used")])
    return ModelSignature(inputs=Schema([*words, *numbers]), outputs=solution, params=ParamSchema(arm))


def register_model(client: MlflowClient, run_id: str, name: str, alias: str | None = None) -> str:
    """Make the model of a run a version of ``name`` and let ``alias`` point there; returns the version.

    The version carries a card: the run's note, its parameters and scores. Raises InputError where the run logged no
    model or the name is none.
    """
    check_registration(name, alias)
    run = client.get_run(run_id)
    logged = _logged_models(run)
    if not logged:
        raise InputError(f"run {run_id} logged no model (its status is {run.info.status})")
    scores = {k: f"{v:.4g}" for k, v in run.data.metrics.items() if k.startswith(("test/", "val/"))}
    with use_store(client.tracking_uri):
        made = mlflow_module().register_model(
            f"models:/{logged[-1].model_id}", name, await_registration_for=0, tags={"run": run.info.run_name, **scores}
        )
    client.update_model_version(name, made.version, model_card_text(run))
    if alias:
        client.set_registered_model_alias(name, alias, made.version)
    return str(made.version)


def model_card_text(run) -> str:
    """The description of a registered version, in Markdown: where it comes from, how to use it, how good it is."""
    params = run.data.params
    shown = {key: params[key] for key in ("data.datasets", "imu.name", "seed", "trainer.max_epochs") if key in params}
    rows = "\n".join(f"- {key}: `{value}`" for key, value in shown.items())
    how = (
        "`predict` takes a table of a drive (the input example), or folders of datasets, `{'dataset': ['data/town']}`."
    )
    return f"# {run.info.run_name}\n\nRun `{run.info.run_id}`. {how}\n\n{rows}\n\n{run.data.tags.get(NOTE_TAG, '')}"


def _log_model_metrics(run: TrackedRun, model_id: str, metrics: Mapping[str, float]) -> None:
    """Metrics of the run that stand beside the model and its dataset in the UI."""
    from mlflow.entities import Metric
    from mlflow.utils.time import get_current_time_millis

    given = run.client.get_run(run.id).inputs
    inputs = given.dataset_inputs if given else []
    data = {}
    if len(inputs) == 1:
        data = {"dataset_name": inputs[0].dataset.name, "dataset_digest": inputs[0].dataset.digest}
    # a time of its own: MLflow links what the run has logged to a new model itself, and refuses the same point twice
    now = get_current_time_millis()
    points = [Metric(key, float(value), now, 0, model_id=model_id, **data) for key, value in metrics.items()]
    run.client.log_batch(run.id, metrics=points)


def pin_requirements() -> list[str]:
    """What a logged model needs, in the installed versions; without build tags: ``2.13.0+cpu`` → ``2.13.0``."""
    return [f"{name}=={version(name).partition('+')[0]}" for name in REQUIRED]


def check_registration(register: str | None, alias: str | None, keys: tuple[str, str] = ("name", "alias")) -> None:
    """Raises InputError for a name or an alias that the model registry would refuse in the end, by the ``keys`` that
    gave them."""
    if register is not None and not re.fullmatch(r"[^/:@]+", register):
        raise InputError(f"{keys[0]}={register}: a name in the registry has none of / : @")
    if alias is not None and (
        not re.fullmatch(r"[\w-]+", alias) or alias.lower() == "latest" or re.fullmatch(r"[vV]\d+", alias)
    ):
        raise InputError(
            f"{keys[1]}={alias}: letters, digits, _ and - only, and neither latest nor v<number>; such as champion"
        )


def download_model(spec: str, uri: str | None = None) -> Path:
    """Folder with ``weights.safetensors`` and ``config.yaml`` of a model in MLflow.

    ``spec``: a run id, ``runs:/<id>[/…]``, ``models:/<name>@<alias>``, ``models:/<name>[/<version>]`` (the
    newest without one) or ``models:/m-<id>``. Raises InputError where there is no such store, run, model,
    version or alias.
    """
    uri = tracking_uri(uri)
    if store_missing(uri):
        raise InputError(
            f"model={spec}: there is no MLflow store at {uri.removeprefix('sqlite:///')}; "
            "run from the folder of the training or give tracking.uri=…"
        )
    with reachable(uri):
        client = open_client(uri)
        find = _find_registered if spec.startswith("models:/") else _find_in_run
        return _fetch(find(client, spec, uri), spec, uri)


def _logged_models(run: Run) -> list:
    return run.outputs.model_outputs if run.outputs else []


def _find_in_run(client: MlflowClient, spec: str, uri: str) -> str:
    run_id = spec.removeprefix("runs:/").partition("/")[0]
    if not RUN_ID.fullmatch(run_id) or not run_exists(client, run_id):
        raise InputError(f"model={spec}: {uri} has no run {run_id!r}")
    run = client.get_run(run_id)
    logged = _logged_models(run)
    if logged:
        return client.get_logged_model(logged[-1].model_id).artifact_location
    children = client.search_runs([run.info.experiment_id], f"tags.`{PARENT_TAG}` = '{run_id}'", max_results=1)
    if children:
        raise InputError(f"model={spec} is the parent run of a grid search; name one of its children")
    raise InputError(f"model={spec}: the run logged no model (its status is {run.info.status})")


def _find_registered(client: MlflowClient, spec: str, uri: str) -> str:
    from mlflow.exceptions import MlflowException

    reference = spec.removeprefix("models:/")
    match = SPEC.fullmatch(reference)
    if match is None:
        raise InputError(f"model={spec} is malformed; write models:/<name>@<alias>, models:/<name>/<version>")
    name, alias, number = match["name"], match["alias"], match["version"]
    if "'" in name:
        raise InputError(f"model=models:/{name}: a name with a quote cannot be looked up")
    try:
        if name.startswith("m-") and not alias and not number:
            return client.get_logged_model(name).artifact_location
        versions = sorted(int(v.version) for v in client.search_model_versions(f"name='{name}'"))
        aliases = client.get_registered_model(name).aliases
    except MlflowException as error:
        if error.error_code != "RESOURCE_DOES_NOT_EXIST":
            raise
        known = ", ".join(m.name for m in client.search_registered_models(max_results=20)) or "none"
        if known == "none":
            known += "; run from the folder of the training or give tracking.uri=…"
        raise InputError(f"model={spec}: {uri} has no model {name!r}; known: {known}") from None
    if alias:
        if alias not in aliases:
            known = ", ".join(f"{a} (version {v})" for a, v in aliases.items()) or "none"
            raise InputError(f"model={spec}: {name} has no alias {alias!r}; known: {known}")
        number = aliases[alias]
    if not versions:
        raise InputError(f"model={spec}: {name} has no versions")
    wanted = versions[-1] if number in (None, "latest") else int(number)
    if wanted not in versions:
        known = ", ".join(map(str, versions))
        raise InputError(f"model={spec}: {name} has no version {wanted}; known: {known}")
    return client.get_model_version_download_uri(name, str(wanted))


def _fetch(source: str, spec: str, uri: str) -> Path:
    """The files, where they lie or in a folder that goes with this process."""
    from mlflow.artifacts import download_artifacts
    from mlflow.exceptions import MlflowException

    there = None
    if not source.startswith("file:"):
        there = tempfile.mkdtemp(prefix="dlkf-model-")
        atexit.register(shutil.rmtree, there, ignore_errors=True)
    try:
        folder = Path(download_artifacts(artifact_uri=source, dst_path=there, tracking_uri=uri))
    except (OSError, MlflowException) as error:
        reason = first_line(error)
        hint = "; a store has absolute places: move its folder back" if there is None else ""
        raise InputError(f"model={spec}: its files cannot be read from {source}: {reason}{hint}") from None
    found = sorted(folder.rglob(WEIGHTS))
    if not found:
        raise InputError(f"model={spec}: {source} holds no {WEIGHTS}; was this model logged by dlkf?")
    return found[0].parent
