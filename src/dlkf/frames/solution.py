"""The solution of a drive as a frame that shows itself in a notebook and writes itself in other formats."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from dlkf.base.errors import InputError

if TYPE_CHECKING:
    import plotly.graph_objects as go

    from dlkf.data.tables import DriveClock
    from dlkf.frames.figures import NotebookFigure
    from dlkf.running.grid import UsableFixes
    from dlkf.running.offline import Navigated


class Solution(pd.DataFrame):
    """A solution as a frame: t, lat_deg, lon_deg, height_m, vel_n|e|d [m/s], roll, pitch, yaw [rad], accel_error_x|y|z
    [m/s²], gyro_error_x|y|z [rad/s], std_* of all of them, gnss_used. Operations on it give plain frames.

    Attributes
    ----------
    summary : str
        Alignment, fixes used, the filter's own 1σ and its normalised innovations, in one line.
    warning : str or None
        Where the filter's 1σ does not fit its innovations: by how much, and the remedy.
    """

    summary: str
    warning: str | None
    _navigated: Navigated
    _fixes: UsableFixes
    _metadata = ["summary", "warning", "_navigated", "_fixes"]  # noqa: RUF012  pandas adds a list to it

    @classmethod
    def of(cls, navigated: Navigated, fixes: UsableFixes, model: str, remedy: str) -> Solution:
        """The frame of a drive that was navigated with ``model``; ``remedy`` if that is overconfident."""
        from dlkf.running.offline import sigma_warning

        solution = cls(navigated.table)
        kept = {
            "summary": navigated.summary(fixes).removeprefix(f"{navigated.drive}: "),
            "warning": sigma_warning([navigated], model, remedy),
        }
        for name, value in (kept | {"_navigated": navigated, "_fixes": fixes}).items():
            object.__setattr__(solution, name, value)
        return solution

    @property
    def _constructor(self) -> Any:
        return pd.DataFrame

    def map(self) -> go.Figure:
        """The track in metres (plotly), coloured by time without GNSS, quality of the fixes or the filter's 1σ."""
        import plotly.graph_objects as go

        from dlkf.report.maps import in_metres
        from dlkf.report.navigation import TrackOnMap, route_map

        figure = in_metres(route_map([TrackOnMap(self._navigated, self._fixes)]))
        return go.Figure(figure.data, figure.layout)

    def plot(self) -> NotebookFigure:
        """Track with the fixes, horizontal 1σ and innovations over their 1σ against time (matplotlib)."""
        from dlkf.frames.figures import draw_solution

        return draw_solution(self._navigated, self._fixes)

    def export(self, folder: str | Path, formats: str | Sequence[str] = "all", *, start_utc: str | None = None) -> Path:
        """Write the solution for other programs into a folder, which is made: ``solution.gpx``, ``.kml``, ``.csv``, ….

        Parameters
        ----------
        folder : str or Path
            Where to; files of the same names are replaced.
        formats : str or sequence of str
            ``geojson``, ``kml``, ``gpx``, ``nmea``, ``pos``, ``tum``, ``kitti``, ``csv``, ``mcap``, ``bag``, or all.
        start_utc : str, optional
            UTC at t = 0, such as ``2025-07-05T10:15:00``, for formats with dates. Without it, t is taken for Unix or
            GPS seconds where it is of their size; else tracks have no dates.

        Raises
        ------
        InputError
            For an unknown format, a date that is none, or a folder that cannot be written to.
        """
        from dlkf.running.exports import choose_formats, export, find_row_qualities, utc_times

        if not isinstance(folder, (str, Path)):
            raise InputError(f"folder is {folder!r}, must be a path")
        if not formats or not isinstance(formats, (str, list, tuple)):
            raise InputError(f"formats is {formats!r}, must be a name or a list of names such as ['gpx', 'kml']")
        names = choose_formats([formats] if isinstance(formats, str) else list(formats), "formats")
        clock, counts = _clock(start_utc)
        when = utc_times(self, clock, counts)
        qualities = find_row_qualities(self, self._fixes.t, self._fixes.quality)
        place = Path(folder).expanduser()
        try:
            place.mkdir(parents=True, exist_ok=True)
            export(place, pd.DataFrame(self), names, when, "solution", qualities)
        except OSError as error:
            raise InputError(f"{place} cannot be written to: {(error.strerror or str(error)).lower()}") from None
        return place

    def _repr_html_(self) -> str:
        from dlkf.frames.figures import as_html

        warning = f"<p><b>{self.warning}</b></p>" if self.warning else ""
        table = pd.DataFrame(self)._repr_html_()  # type: ignore[operator]
        return f"<p>{self.summary}</p>{warning}{as_html(self.plot())}{table}"


def _clock(start_utc: str | None) -> tuple[DriveClock, str]:
    """What t counts, for :func:`dlkf.running.exports.utc_times`."""
    from dlkf.data.tables import DriveClock

    if start_utc is None:
        return DriveClock(file_s=0.0), "auto"
    try:
        start = pd.Timestamp(start_utc)
        start = start.tz_localize("UTC") if start.tzinfo is None else start.tz_convert("UTC")
        return DriveClock(file_s=start.timestamp()), "unix"
    except (TypeError, ValueError):
        raise InputError(f"start_utc is {start_utc!r}, must be a date and time such as 2025-07-05T10:15:00") from None
