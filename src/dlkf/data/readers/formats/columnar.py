"""Parquet, Feather and Arrow files of one's own, by pyarrow; columns are mapped like those of a text table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.feather as feather
import pyarrow.parquet as pq

from dlkf.base.errors import InputError, first_line
from dlkf.data.readers.frames import LogTable


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> LogTable:
    """A file of columns; time stamps become whole nanoseconds since 1970."""
    try:
        if path.suffix in (".feather", ".arrow", ".ipc"):
            columns = feather.read_table(path)
        else:
            columns = pq.ParquetFile(path).read()
    except (pa.ArrowInvalid, OSError) as error:
        reason = first_line(error)
        raise InputError(f"{path}: not a whole Parquet or Feather file ({reason}); write or copy it again") from None
    frame = columns.to_pandas(ignore_metadata=True)
    for name in frame.columns:
        if isinstance(frame[name].dtype, pd.DatetimeTZDtype) or frame[name].dtype.kind == "M":
            utc = pd.to_datetime(frame[name], utc=True).dt.as_unit("ns")
            frame[name] = utc.astype("int64")
    frame.columns = [str(c) for c in frame.columns]
    if not len(frame):
        raise InputError(f"{path}: has no rows; leave the drive out or give its data")
    return LogTable(frame, path)
