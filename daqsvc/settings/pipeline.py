"""What is computed from the samples: what all detectors share; each has its own table below it."""

from __future__ import annotations

from typing import Annotated, TypeVar

from pydantic import Field

from daqsvc.settings.section import Section, WaitMs

TableT = TypeVar("TableT", bound=Section)


class Alignment(Section):
    """Lets a rotor detector take its sensors from several streams, with their own clocks."""

    max_error_us: Annotated[float, Field(ge=0.01, le=1_000_000)] = Field(
        default=200.0, description="samples that may be further off the reference's are left out"
    )
    max_wait_ms: WaitMs = Field(
        default=1000.0, description="how long after all others a stream may come before the rest goes on"
    )


class Pipeline(Section):
    """The detectors, and how much of the past they can reach.

    `daqsvc.settings.registry.pipeline_model` adds the tables of the detectors that are installed.
    """

    ring_s: Annotated[float, Field(ge=0.01, le=3600)] = Field(
        default=30.0, description="how much of the past is kept in memory, of each stream"
    )
    alignment: Alignment | None = Field(
        default=None,
        description="how sensors of a rotor detector that lie in several streams are aligned in time",
    )

    def table(self, kind: type[TableT]) -> TableT | None:
        """The table of a detector, by its class; None if the file has none.

        Raises:
            UnusableValueError: it is there and not valid.
        """
        for key in type(self).model_fields:
            settings = getattr(self, key) if key not in Pipeline.model_fields else None
            if isinstance(settings, kind):
                return settings
        return None
