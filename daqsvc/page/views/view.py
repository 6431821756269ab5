"""What all views have in common."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from daqsvc.page.charts import Theme
    from daqsvc.page.machine_live import MachineLive


NO_WAVEFORM = "no sensor of vibration is sampled fast enough for a spectrum"


@dataclass(frozen=True, slots=True)
class Choice:
    """One thing that can be chosen in a view.

    Attributes:
        name: of the parameter in the address.
        label: what a person reads.
        options: by value, what a person reads; the first one is chosen unless another one is.
    """

    name: str
    label: str
    options: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of a view.

    Attributes:
        name: unique in the view.
        label: what it shows, for who does not see it.
        made: the Bokeh figure.
    """

    name: str
    label: str
    made: Any


@dataclass(frozen=True, slots=True)
class Shown:
    """What a view shows at a moment.

    Attributes:
        sources: by source, by column, an array of one dimension or a list of texts.
        rows: figures in words: what, value, unit.
        note: why there is less to see than there could be; empty if there is not.
    """

    sources: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    rows: Collection[tuple[str, str, str]] = ()
    note: str = ""


class MachineView(Protocol):
    """One way to look at a machine.

    Attributes:
        name: in the address.
        title: what a person reads.
        sentence: what it shows.
        every_s: how often it is made again while somebody looks.
    """

    name: str
    title: str
    sentence: str
    every_s: float

    def choices(self, live: MachineLive) -> list[Choice]:
        """What can be chosen."""
        ...

    def why_not(self, live: MachineLive) -> str:
        """Why this machine has no such view; empty if it has one."""
        ...

    def streams(self, live: MachineLive, chosen: Mapping[str, str]) -> set[str]:
        """The streams whose samples it needs."""
        ...

    def figures(self, live: MachineLive, chosen: Mapping[str, str], theme: Theme) -> list[Figure]:
        """Its figures, without data."""
        ...

    def shown(self, live: MachineLive, chosen: Mapping[str, str]) -> Shown:
        """What is to be seen now; may take long, and runs on a thread."""
        ...
