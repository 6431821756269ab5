"""The archive of a fleet: the recordings of many machines, judged on Dask into one table."""

from daqsvc.errors.command_line import ARCHIVE


class FleetError(Exception):
    """An archive, a cluster or a table of results cannot be used; the text states why, and what to do."""

    code = ARCHIVE
