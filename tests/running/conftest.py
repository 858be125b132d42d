"""Drives on the analytic path."""

from tests.data.conftest import tables, town

__all__ = ["tables", "town"]
