"""A folder of runs that was moved or renamed: the embedded store has absolute places of its artifacts."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from urllib.parse import unquote, urlsplit

PLACES = (
    ("experiments", "artifact_location"),
    ("runs", "artifact_uri"),
    ("logged_models", "artifact_location"),
    ("model_versions", "source"),
    ("model_versions", "storage_location"),
)


def follow(store: Path, artifacts: str) -> None:
    """Let the artifacts' places in ``store`` point beside it, where they lie now and the old folder is gone.

    Nothing is touched while the old folder exists (a copy of a project must not take over its runs).
    """
    here = (store.parent / artifacts).as_uri()
    if not store.is_file() or not (store.parent / artifacts).is_dir():
        return
    with closing(sqlite3.connect(store, timeout=20)) as database, database:
        try:
            rows = database.execute("select distinct artifact_location from experiments").fetchall()
        except sqlite3.OperationalError:  # a store that MLflow has yet to make
            return
        roots = {str(place).rpartition(f"/{artifacts}/")[0] for (place,) in rows if f"/{artifacts}/" in str(place)}
        for root in roots:
            old = f"{root}/{artifacts}"
            if old == here or not old.startswith("file:") or Path(unquote(urlsplit(old).path)).exists():
                continue
            for table, column in PLACES:
                if column in {row[1] for row in database.execute(f"pragma table_info({table})")}:
                    change = f"update {table} set {column} = ? || substr({column}, ?) where {column} like ? || '/%'"
                    database.execute(change, (here, len(old) + 1, old))
