"""What has to be known about a rotor and its probes before a recording of it can be judged."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from daqsvc.rotor.synchronous.watch import WatchRules

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.dsp.speed.keyphasor import Edge
    from daqsvc.recording.channels import LengthUnit
    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.synchronous.baseline import Calibration

SpeedSource = Literal["fixed", "orbit", "keyphasor"]


class RefusedError(ValueError):
    """A recording cannot be judged; the message names the thing, its value and the remedy."""


@dataclass(frozen=True, slots=True)
class Keyphasor:
    """The keyphasor of a recording.

    Attributes:
        name: its channel.
        threshold: level that marks the edge, in the unit of the channel; None: half way between the lowest
            and the highest value.
        edge: the edge that marks angle zero.
        hysteresis: how far the signal must return before there can be another edge; None: a fifth of its
            range.
    """

    name: str
    threshold: float | None = None
    edge: Edge = "rising"
    hysteresis: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RotorSetup:
    """What `analyse` needs to know.

    Attributes:
        probes: names of the two channels.
        rotor: what is known about the rotor.
        probe_angles_deg: where they point, from +x against the clock.
        speed_rpm: shaft speed, negative if the shaft turns clockwise; may be None with a keyphasor.
        speed_step_rpm: step of the stated speed's last digit, which it is rounded to; 0: it is exact.
        unit: unit of the probes' samples.
        keyphasor: the keyphasor, if there is one.
        follow_orbit: take speed and angle from the orbit's own 1X, about ``speed_rpm``.
        rules: of calibration, departure and naming.
        calibrations: healthy states of an earlier time, each at another speed, of which the measured speed
            chooses; without any the first revolutions are the healthy state.
        ac_coupled: whether the probes lack their mean position.
        channels: what a channel is called in the file, where that is not its name here.
        rate_hz: samples per second; None: what the file says.

    Raises:
        ValueError: the figures contradict each other.
    """

    probes: tuple[str, str]
    rotor: LavalRotor
    speed_rpm: float | None
    probe_angles_deg: tuple[float, float] = (0.0, 90.0)
    speed_step_rpm: float = 0.0
    unit: LengthUnit = "um"
    keyphasor: Keyphasor | None = None
    follow_orbit: bool = False
    rules: WatchRules = field(default_factory=lambda: WatchRules(retry=False))
    calibrations: tuple[Calibration, ...] = ()
    ac_coupled: bool = False
    channels: Mapping[str, str] = field(default_factory=dict)
    rate_hz: float | None = None

    def __post_init__(self) -> None:
        if self.speed_rpm is None and self.keyphasor is None:
            raise ValueError(
                "the speed is not known: give it with --speed-rpm, or name a keyphasor with --keyphasor"
            )
        if self.keyphasor is not None and self.follow_orbit:
            raise ValueError(
                "speed and angle come either from the keyphasor or from the orbit: leave out --keyphasor, or "
                "follow the orbit no more"
            )
        named = [*self.probes, *([self.keyphasor.name] if self.keyphasor is not None else [])]
        if len({self.channels.get(name, name) for name in named}) < len(named):
            raise ValueError(
                f"probes {self.probes[0]!r} and {self.probes[1]!r} and the keyphasor must be different "
                "channels of the recording; correct --probes, --keyphasor or --map"
            )

    @property
    def speed_source(self) -> SpeedSource:
        """Where speed and angle come from."""
        if self.keyphasor is not None:
            return "keyphasor"
        return "orbit" if self.follow_orbit else "fixed"

    @property
    def columns(self) -> dict[str, str]:
        """The channels to load, and what they are called in the file."""
        names = [*self.probes, *([self.keyphasor.name] if self.keyphasor is not None else [])]
        return {name: self.channels.get(name, name) for name in names}
