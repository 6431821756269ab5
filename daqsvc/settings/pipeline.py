"""What is computed from the samples: what all detectors share; each has a table of its own below it."""

from __future__ import annotations

from typing import Annotated, TypeVar

from pydantic import Field

from daqsvc.settings.alignment import Alignment  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import Section

TableT = TypeVar("TableT", bound=Section)


class Pipeline(Section):
    """The detectors, and how much of the past they can reach.

    `daqsvc.settings.registry.pipeline_model` adds the tables of the detectors that are installed.
    """

    ring_s: Annotated[float, Field(ge=0.01, le=3600)] = Field(
        default=30.0, description="length of each stream's ring"
    )
    alignment: Alignment | None = Field(
        default=None, description="sensors of a rotor detector in several streams"
    )

    def table(self, kind: type[TableT]) -> TableT | None:
        """The table of a detector, by its class; None if the file has none.

        Raises:
            UnusableValueError: it is there and not valid.
        """
        for key in type(self).model_fields:
            given = getattr(self, key) if key not in Pipeline.model_fields else None
            if isinstance(given, kind):
                return given
        return None
