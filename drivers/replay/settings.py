"""Recordings in place of a bus."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from daqsvc.recording.formats import READERS, named_as_table
from daqsvc.settings.buses import Bus, Layout
from daqsvc.settings.files import FilePath  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.packing import Scale  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import MOST_CHANNELS, Name, Quantity, Section, Text

TABLES = ", ".join(READERS)
"""Endings of the files that hold a table of samples, in words; any other is a CAN log."""


class ReplayBus(Bus):
    """A recording that is played as if it came over a bus."""

    kind: ClassVar[str] = "a replayed bus"

    driver: Annotated[Literal["replay"], Field(description="which driver reads the bus", examples=["replay"])]
    file: Annotated[
        FilePath,
        Field(
            description="a CAN log (.log, .asc, .blf, .trc; .gz if zipped) or a table of samples "
            f"({TABLES}), relative to the machine file",
            examples=["run-up.blf"],
        ),
    ]
    channel: Annotated[
        Text | None,
        Field(
            description="which channel of a CAN log that holds several, as the log calls it; the first one "
            "in it if left out",
            examples=["can0", "1"],
        ),
    ] = None
    at_end: Literal["stop", "loop", "wait"] = Field(
        default="stop",
        description="what to do at the end of the file: stop, play it again, or wait for more",
    )
    pace: Literal["recorded", "unpaced"] = Field(
        default="recorded", description="how fast it is played: as it was recorded, or as fast as possible"
    )
    max_memory_gb: float | None = Field(
        default=None,
        ge=0.05,
        le=1000.0,
        description="memory that reading a table may take, in GB; if left out half of the machine's, "
        "at most 4",
        examples=[4.0],
    )

    @property
    def is_table(self) -> bool:
        """Whether the file holds a table of samples rather than CAN frames."""
        return named_as_table(self.file)

    @property
    def summary(self) -> str:
        """The sentence that describes it to a person."""
        end = {"stop": "once", "loop": "again and again", "wait": "as it is written"}[self.at_end]
        channel = "" if self.channel is None else f", channel {self.channel}"
        return f"replay of {self.file}{channel}, {end}{', unpaced' if self.pace == 'unpaced' else ''}"


class TableColumn(Section):
    """One quantity of a table: wire value = value * scale + offset, as for a channel of a frame."""

    name: Annotated[Name, Field(description="name of the channel", examples=["x"])]
    column: Annotated[
        Text,
        Field(
            description="column of the table: a name in the first line of a CSV file, or an array of NPZ",
            examples=["probe_x_v"],
        ),
    ]
    scale: Scale = Field(
        default=1.0, description="what a 1 in the table is worth, in V or the unit of the sensor"
    )
    offset: Quantity = Field(
        default=0.0, description="what a 0 in the table is worth, in V or the unit of the sensor"
    )


class TableLayout(Layout):
    """Samples as columns of a table."""

    kind: ClassVar[str] = "a layout of columns in a table"
    mark: ClassVar[str] = "columns"
    channels_key: ClassVar[str] = "columns"

    columns: Annotated[
        tuple[TableColumn, ...],
        Field(
            strict=False,
            min_length=1,
            max_length=MOST_CHANNELS,
            description="the channels of each sample",
            examples=['[{ name = "x", column = "probe_x_v" }]'],
        ),
    ]

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in the order of a sample."""
        return tuple(column.name for column in self.columns)

    @property
    def summary(self) -> str:
        """The sentence that describes it to a person."""
        return f"columns {', '.join(column.column for column in self.columns)}"
