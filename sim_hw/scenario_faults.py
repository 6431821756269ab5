"""The ``[[fault]]`` tables of a scenario file: what goes wrong with nodes and their link, and when."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, model_validator

from sim_hw.link_faults import LinkFaults
from sim_hw.node_faults import EVER, Babble, Drift, FaultWindow, FrameDelay, NodeFaults

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Self

Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_MS_PER_S = 1000.0


class ScenarioTable(BaseModel):
    """A table of a scenario file: no key but those that are known."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _Timed(ScenarioTable):
    """A fault from ``from_s`` to ``to_s`` of the playing; for all the rest of it unless ``to_s`` is given."""

    from_s: Seconds = 0.0
    to_s: Seconds | None = None

    @property
    def window(self) -> FaultWindow:
        """When it is there."""
        return FaultWindow(self.from_s, math.inf if self.to_s is None else self.to_s)

    @model_validator(mode="after")
    def _check(self) -> Self:
        planned_faults([self], None, 0)  # type: ignore[list-item]
        return self


class LinkFaultRates(ScenarioTable):
    """Probabilities per frame of what the link does wrong, see `LinkFaults`."""

    drop: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    reorder_within_ms: float = Field(default=5.0, ge=0, allow_inf_nan=False)

    @model_validator(mode="after")
    def _check_rates(self) -> Self:
        self.for_seed(0)
        return self

    def for_seed(self, seed: int) -> LinkFaults:
        """The link with its random draws fixed."""
        return LinkFaults(
            drop=self.drop,
            duplicate=self.duplicate,
            reorder=self.reorder,
            corrupt=self.corrupt,
            reorder_within_ns=round(self.reorder_within_ms * 1e6),
            seed=seed,
        )


class LinkTable(_Timed, LinkFaultRates):
    """The link drops, doubles, reorders or corrupts frames for a while."""

    kind: Literal["link"]


class DelayTable(_Timed):
    """Frames are late, by as much for each or by chance."""

    kind: Literal["delay"]
    delay_ms: Seconds = 0.0
    jitter_ms: Seconds = 0.0


class DriftTable(_Timed):
    """The clocks of the nodes are wrong."""

    kind: Literal["drift"]
    ppm: float


class SilenceTable(_Timed):
    """The nodes sample and send nothing."""

    kind: Literal["silence"]


class BrownOutTable(_Timed):
    """The nodes have no power, and count from 0 when they have it again."""

    kind: Literal["brown-out"]


class BabbleTable(_Timed):
    """Another node fills the bus with frames of its own."""

    kind: Literal["babble"]
    rate_hz: float = Field(gt=0)
    id: int = Field(default=0, ge=0, lt=2**11)


class CounterResetTable(ScenarioTable):
    """The nodes count from 0 again, without a pause."""

    kind: Literal["counter-reset"]
    at_s: float = Field(gt=0, allow_inf_nan=False)


FaultTable: TypeAlias = Annotated[
    LinkTable | DelayTable | DriftTable | SilenceTable | BrownOutTable | BabbleTable | CounterResetTable,
    Field(discriminator="kind"),
]


def planned_faults(
    tables: Sequence[FaultTable], always: LinkFaultRates | None, seed: int
) -> NodeFaults | None:
    """What the tables of a scenario say goes wrong; None if nothing does.

    Args:
        tables: its ``[[fault]]`` tables.
        always: its ``[link_faults]`` table: a link fault all the time.
        seed: of every random draw.

    Raises:
        ValueError: something in a table cannot be, or two of them contradict each other.
    """
    if not tables and always is None:
        return None
    link = [(EVER, always.for_seed(seed))] if always is not None else []
    link += [(t.window, t.for_seed(seed)) for t in tables if isinstance(t, LinkTable)]
    return NodeFaults(
        drift=[Drift(t.window, t.ppm) for t in tables if isinstance(t, DriftTable)],
        brown_out=[t.window for t in tables if isinstance(t, BrownOutTable)],
        counter_reset_s=[t.at_s for t in tables if isinstance(t, CounterResetTable)],
        silence=[t.window for t in tables if isinstance(t, SilenceTable)],
        link=link,
        delay=[
            FrameDelay(t.window, t.delay_ms / _MS_PER_S, t.jitter_ms / _MS_PER_S)
            for t in tables
            if isinstance(t, DelayTable)
        ],
        babble=[Babble(t.window, t.rate_hz, t.id) for t in tables if isinstance(t, BabbleTable)],
        seed=seed,
    )
