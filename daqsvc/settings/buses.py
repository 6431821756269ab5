"""What every kind of bus and every layout of samples has, whichever driver they belong to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import ConfigDict, Field

from daqsvc.settings.hooks import Hooks, contract
from daqsvc.settings.section import Name, Section, UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping

StartPolicy = Literal["error", "retry", "ignore"]

BUSY = 0.8
"""A bus or line that takes a larger share of its time for streams leaves no room for anything else."""

START = "what to do if the device is absent at start"


class Device(NamedTuple):
    """What a bus has for itself: no other bus of the machine file may name it.

    Attributes:
        key: the key that names it.
        identity: compares equal, and has the same hash, for whatever is the same device.
        remedy: what to do about two buses that name it.
    """

    key: str
    identity: Hashable
    remedy: str


@contract
class Bus(Hooks, Section):
    """A bus; each driver has its own kind, or several, with its options as fields.

    `kind` states what it is called in messages, e.g. ``"a CAN bus"``.
    """

    driver: Annotated[
        Name, Field(description="name of the driver that reads the bus", examples=["my-driver"])
    ]
    start: StartPolicy = Field(default="retry", description=START)

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        options = [f"{key} {value}" for key, value in self if key not in {"driver", "start"}]
        return ", ".join([f"driver {self.driver}", *options])

    @property
    def device(self) -> Device | None:
        """What no other bus of the machine file may name; None if it may be shared."""
        return None


class UnknownBus(Bus):
    """A bus whose driver is not installed: it is not known what its table may hold."""

    model_config = ConfigDict(extra="ignore")
    kind: ClassVar[str] = "a bus without a driver"


class WireRange(NamedTuple):
    """What a channel of whole numbers can carry, in volts or in the unit of its sensor.

    Attributes:
        low: least value.
        high: largest value.
        step: worth of one count; 0 if it is not known.
    """

    low: float
    high: float
    step: float

    @classmethod
    def scaled(cls, raw: tuple[float, float], scale: float, offset: float) -> WireRange:
        """Of raw numbers between two ends."""
        ends = [end * scale + offset for end in raw]
        return cls(min(ends), max(ends), abs(scale))


class Block(NamedTuple):
    """Samples that a device takes at once and keeps until the next ones replace them.

    Attributes:
        samples: of each channel.
        every_s: how often the device is asked to take them; None if it does so by itself.
        buffer_bytes: memory that reading them takes besides.
    """

    samples: int
    every_s: float | None
    buffer_bytes: int


@contract
class Layout(Hooks, Section):
    """Where the samples of a stream lie in what comes over its bus; each driver has its own kinds."""

    mark: ClassVar[str] = ""
    """The key by which a table is known to be of this kind; the first kind of all needs none."""
    channels_key: ClassVar[str] = "channels"
    """The key that lists the channels."""
    usual_rate_hz: ClassVar[float] = 640.0
    """The rate that a remedy shows for streams of this kind."""
    number_keys: ClassVar[str] = ""
    """The keys that define how bytes become numbers, e.g. ``"order and type"``; of texts there are none."""

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in the order of a sample."""
        raise NotImplementedError

    @property
    def summary(self) -> str:
        """What a person should know about it, in a few words."""
        return ", ".join(self.channel_names)

    @property
    def block(self) -> Block | None:
        """The block that the samples come in; None if they come one after another without end."""
        return None

    @property
    def polled(self) -> bool:
        """Whether it is asked for present values, so that there is no waveform."""
        return False

    def wire_range(self, channel: str, facts: Any) -> WireRange | None:
        """What a channel can carry; None of a float or a text, and where it is not known.

        Args:
            channel: its name.
            facts: what was read from the files that the layout names; None without any.
        """
        del channel, facts
        return None

    def value_names(self, channel: str, facts: Any) -> Mapping[float, str]:
        """What some values of a channel mean, as of a state; empty where that is not known.

        Args:
            channel: its name.
            facts: what was read from the files that the layout names; None without any.
        """
        del channel, facts
        return {}


class UnknownLayout(Layout):
    """A layout where no driver is installed."""

    model_config = ConfigDict(extra="ignore")

    @property
    def channel_names(self) -> tuple[str, ...]:
        """See `Layout.channel_names`.

        Raises:
            UnusableValueError: always.
        """
        raise UnusableValueError("channels")


def percent(least: float, most: float) -> str:
    """A range of shares of a bus's time, for a person: it depends on data and devices."""
    low, high = f"{100 * least:.2g}", f"{100 * most:.2g}"
    return f"{low} %" if low == high else f"{low} to {high} %"
