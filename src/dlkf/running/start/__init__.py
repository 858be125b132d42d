"""The start of a filter on a drive without truth: :func:`align_each` for drives, :class:`Search` for a stream."""

from dlkf.running.start.bank import EarthFix
from dlkf.running.start.entry import LOOKBACK_S, Search, align, align_drives, align_each

__all__ = ["LOOKBACK_S", "EarthFix", "Search", "align", "align_drives", "align_each"]
