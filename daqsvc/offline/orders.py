"""From recordings of accelerometers without a keyphasor to a verdict: is 1X still that of the healthy run?

It needs a healthy run to compare with, and so there is no detector of the service like it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, TypedDict, cast

import numpy as np

from daqsvc.detectors.shaft.verdict import VERDICTS
from daqsvc.diagnosis.recorded import Evaluated, RecordedDetector, Verdict, finite
from daqsvc.dsp.orders import OrderVectors, order_vectors
from daqsvc.dsp.quality import RefusedError
from daqsvc.dsp.quality.recorded import DataQuality, DataQualityJson, known_against, off_stated_speed
from daqsvc.dsp.quality.unit import M_S2_PER_UNIT
from daqsvc.dsp.speed.lines import ORDERS
from daqsvc.recording import RecordingError
from daqsvc.recording.recording import load_recording
from daqsvc.rotor.orders import OrderChange, OrderRules, compare_orders
from daqsvc.settings.section import Section

if TYPE_CHECKING:
    from collections.abc import Container, Iterator

    from numpy.typing import NDArray

    from daqsvc.diagnosis.recorded import Progress, Recorded, RecordingOptions
    from daqsvc.dsp.quality.unit import AccelerationUnit
    from daqsvc.recording.recording import Recording
    from daqsvc.settings.models import MachineFile

    Floats: TypeAlias = NDArray[np.float64]


class Orders(Section):
    """What counts as a change of the orders; in no machine file, but made of options."""

    false_alarm_probability: float


class RecordedOrders(RecordedDetector[Orders]):
    """The orders of all accelerometers of a machine against those of a healthy run.

    Raises:
        ValueError: the healthy run cannot be read or measured.
    """

    part = "rotor"

    def __init__(self, machine: MachineFile, settings: Orders, options: RecordingOptions) -> None:
        super().__init__(machine, settings, options)
        self._setup = OrderSetup(
            channels=tuple(sensor.name for sensor in machine.sensors),
            speed_rpm=machine.machine.speed_rpm,
            unit=cast("AccelerationUnit", machine.sensors[0].unit),
            rules=OrderRules(false_alarm_probability=settings.false_alarm_probability),
        )
        self._name = cast("str", options.healthy)
        wanted = {sensor.name: sensor.channel for sensor in machine.sensors}
        try:
            healthy = load_recording(self._name, wanted, options.rate_hz)
            self._baseline = self._setup.orders_of(healthy)
        except (RecordingError, ValueError) as error:
            raise ValueError(f"healthy run {self._name}: {error}") from error

    def as_recorded(self, sensors: Container[str]) -> Orders:
        """See `RecordedDetector.as_recorded`: all accelerometers are there, or nothing is read."""
        del sensors
        return self.settings

    def not_judged(self, recording: str, why: str) -> OrderVerdict:
        """See `RecordedDetector.not_judged`."""
        return OrderVerdict(
            recording=recording,
            baseline=self._name,
            setup=self._setup,
            quality=DataQuality(0),
            refused=why,
        )

    def evaluate(self, recorded: Recorded, settings: Orders, progress: Progress | None) -> Evaluated:
        """See `RecordedDetector.evaluate`."""
        del settings, progress  # a recording takes a tenth of a second
        verdict = analyse_orders(recorded.recording, self._setup, self._baseline, self._name)
        return Evaluated(verdict=verdict)


def order_detectors(
    false_alarm_probability: float, machine: MachineFile, options: RecordingOptions
) -> dict[str, RecordedDetector[Any]]:
    """The comparison as the only detector of a machine, as `daqsvc.offline.runner.Runner` wants it.

    Args:
        false_alarm_probability: of a recording of the unchanged machine, at most.
        machine: the machine, see `daqsvc.offline.machine_options.accelerometer_machine`.
        options: what is stated of the recordings; among that the healthy run.

    Raises:
        ValueError: the healthy run cannot be used.
    """
    settings = Orders.model_construct(false_alarm_probability=false_alarm_probability)
    return {"orders": RecordedOrders(machine, settings, options)}


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderSetup:
    """What `analyse_orders` needs to know.

    Attributes:
        channels: names of the channels, of one unit.
        speed_rpm: nominal shaft speed.
        unit: of the samples; ``"V"`` if the sensors' sensitivity is not known.
        rules: what counts as a change.
    """

    channels: tuple[str, ...]
    speed_rpm: float
    unit: AccelerationUnit = "g"
    rules: OrderRules = field(default_factory=OrderRules)

    def orders_of(self, recording: Recording) -> OrderVectors:
        """Measure a recording.

        Raises:
            ValueError: it cannot be measured.
        """
        return order_vectors(recording.samples, recording.rate_hz, self.speed_rpm, recording.names)


class GrowthJson(TypedDict):
    """How much 1X has grown.

    Attributes:
        ratio: 1X over that of the healthy recording.
        uncertainty: of the ratio, standard deviation.
        significant: whether it is more than chance.
    """

    ratio: float | None
    uncertainty: float | None
    significant: bool


class OrderJson(TypedDict):
    """One order of one channel.

    Attributes:
        healthy: amplitude in the healthy recording.
        present: amplitude in this one.
        ratio: of the two.
        uncertainty: of the present amplitude, standard deviation.
    """

    healthy: float | None
    present: float | None
    ratio: float | None
    uncertainty: float | None


class OrderChannelJson(TypedDict):
    """One channel.

    Attributes:
        orders: by order, such as `1X`.
        residual_ratio: what no order explains, over that of the healthy recording.
        velocity_1x_mm_s_rms: velocity of 1X in mm/s r.m.s.; null if the samples are no acceleration.
    """

    orders: dict[str, OrderJson]
    residual_ratio: float | None
    velocity_1x_mm_s_rms: float | None


class OrderVerdictJson(TypedDict):
    """The verdict about the rotor by orders, of a machine whose healthy recording is known.

    Attributes:
        recording: name of the recording.
        baseline: name of the healthy recording.
        verdict: the most likely change; null if the recording is refused.
        group: all changes that the evidence cannot tell apart, the most likely first.
        probabilities: of every change.
        evidence: of every change, in nats.
        severity: how large the change is; null if the recording is refused.
        growth_1x: how much 1X has grown; null if the recording is refused.
        departure_nats: evidence of any change; null if the recording is refused.
        threshold_nats: evidence from which on it is a change; null if the recording is refused.
        false_alarm_probability: chance of a false alarm that this is set for, for each recording.
        unit: unit of the amplitudes.
        channels: by channel.
        speed_rpm: speed by the harmonics; null if it was not measured.
        speed_uncertainty_rpm: its standard deviation; null if it was not measured.
        speed_seen: whether an order stands out of the noise; null if that was not measured.
        revolutions: whole revolutions in the recording.
        data_quality: what is known against the samples.
        refused: why the recording cannot be judged; null if it can.
        code: code of that reason; null if there is none.
    """

    recording: str
    baseline: str
    verdict: str | None
    group: list[str]
    probabilities: dict[str, float]
    evidence: dict[str, float | None]
    severity: float | None
    growth_1x: GrowthJson | None
    departure_nats: float | None
    threshold_nats: float | None
    false_alarm_probability: float
    unit: str
    channels: dict[str, OrderChannelJson]
    speed_rpm: float | None
    speed_uncertainty_rpm: float | None
    speed_seen: bool | None
    revolutions: int
    data_quality: DataQualityJson
    refused: str | None
    code: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderVerdict(Verdict):
    """What a recording reports about a machine whose healthy run is known; see `Verdict`.

    Attributes:
        baseline: name of the healthy one.
        setup: what it was judged by.
        orders: what was measured; None if refused before.
        change: the verdict and what it was made of; None if refused.
    """

    part: ClassVar[str] = "rotor"

    baseline: str
    setup: OrderSetup
    orders: OrderVectors | None = None
    change: OrderChange | None = None

    def as_json(self) -> dict[str, Any]:
        """A JSON object: all figures finite, amplitudes in the unit of the samples."""
        orders, change = self.orders, self.change
        shares = {} if change is None else {str(name): p for name, p in change.probabilities.items()}
        document: OrderVerdictJson = {
            "recording": self.recording,
            "baseline": self.baseline,
            "verdict": None if change is None else change.verdict,
            "group": [] if change is None else list(change.group),
            "probabilities": {} if change is None else {name: shares.get(name, 0.0) for name in VERDICTS},
            "evidence": {} if change is None else {str(name): nats for name, nats in change.evidence.items()},
            "severity": None if change is None else change.severity,
            "growth_1x": None
            if change is None
            else {
                "ratio": change.growth,
                "uncertainty": change.growth_uncertainty,
                "significant": change.growth_significant,
            },
            "departure_nats": None if change is None else change.departure,
            "threshold_nats": None if change is None else change.departure_threshold,
            "false_alarm_probability": self.setup.rules.false_alarm_probability,
            "unit": self.setup.unit,
            "channels": {} if change is None else self._channels(change),
            "speed_rpm": None if orders is None else orders.speed_rpm,
            "speed_uncertainty_rpm": None if orders is None else orders.speed_uncertainty_rpm,
            "speed_seen": None if orders is None else orders.speed_seen,
            "revolutions": 0 if orders is None else orders.revolutions,
            "data_quality": self.quality.as_json(),
            "refused": self.refused,
            "code": self.refusal_code,
        }
        return {**finite(document)}

    def _channels(self, change: OrderChange) -> dict[str, OrderChannelJson]:
        velocity = self._velocity_mm_s(change)
        return {
            name: {
                "orders": {
                    f"{order}X": {
                        "healthy": change.healthy[row, column],
                        "present": change.present[row, column],
                        "ratio": change.ratio[row, column],
                        "uncertainty": change.present_uncertainty[row, column],
                    }
                    for row, order in enumerate(ORDERS)
                },
                "residual_ratio": change.residual_ratio[column],
                "velocity_1x_mm_s_rms": None if velocity is None else velocity[column],
            }
            for column, name in enumerate(self.setup.channels)
        }

    def _velocity_mm_s(self, change: OrderChange) -> Floats | None:
        """Velocity of 1X in mm/s r.m.s., as ISO 20816 states it; None if the unit is not an acceleration."""
        if self.orders is None or self.setup.unit not in M_S2_PER_UNIT:
            return None
        rad_s = 2.0 * math.pi * self.orders.speed_rpm / 60.0
        scale = 1e3 * M_S2_PER_UNIT[self.setup.unit] / rad_s / math.sqrt(2.0)
        return np.asarray(scale * change.present[0])

    def describe(self) -> str:
        """A few lines for a person."""
        if self.change is None or self.orders is None:
            return f"{self.recording}: not judged: {self.refusal}"
        change, orders = self.change, self.orders
        changes = " or ".join(name.replace("_", " ") for name in change.group)
        seen = "" if orders.speed_seen else ", guessed: no order stands out of the noise"
        lines = [
            f"{self.recording}: {changes}" + (" (cannot be told apart)" if len(change.group) > 1 else "")
        ]
        lines.append(
            f"1X is {change.growth:.3g} (+-{change.growth_uncertainty:.2g}) times that of {self.baseline}; "
            f"departure {change.departure:.1f} nats, threshold {change.departure_threshold:.1f} "
            f"(false alarms: {self.setup.rules.false_alarm_probability:g} a recording)"
        )
        by_channel = zip(self.setup.channels, change.healthy[0], change.present[0], strict=True)
        lines.append(
            "1X by channel: "
            + ", ".join(
                f"{name} {before:.3g} to {after:.3g} {self.setup.unit}" for name, before, after in by_channel
            )
        )
        lines.append(
            f"{orders.speed_rpm:.1f} +-{orders.speed_uncertainty_rpm:.1f} rpm by the harmonics{seen}, "
            f"{orders.revolutions} revolutions"
        )
        if change.residual_changed:
            most = int(np.argmax(change.residual_ratio))
            lines.append(
                f"beside the orders {self.setup.channels[most]} vibrates "
                f"{change.residual_ratio[most]:.2g} times as much as in the healthy run"
            )
        return "\n  ".join([*lines, *self.quality.problems])


def analyse_orders(
    recording: Recording, setup: OrderSetup, baseline: OrderVectors, baseline_name: str
) -> OrderVerdict:
    """Compare a recording with the orders of a healthy run.

    Args:
        recording: to be judged.
        setup: what is known.
        baseline: of the healthy run, measured by the same setup.
        baseline_name: what the healthy run is called.
    """
    name = str(recording.source)
    quality = known_against(recording)
    orders: OrderVectors | None = None
    try:
        orders = setup.orders_of(recording)
        change = compare_orders(baseline, orders, setup.rules)
    except ValueError as error:
        return OrderVerdict(
            recording=name,
            baseline=baseline_name,
            setup=setup,
            quality=quality,
            refused=str(error),
            code=error.code if isinstance(error, RefusedError) else None,
            orders=orders,
        )
    if orders.speed_seen and (problem := off_stated_speed(orders.speed_rpm, setup.speed_rpm)):
        quality = quality.with_problem(problem)
    for note in _of_drives(orders):
        quality = quality.with_problem(note)
    if not baseline.speed_seen:
        quality = quality.with_problem(
            f"no order of {setup.speed_rpm:g} rpm stands out of the healthy run {baseline_name}: if it "
            "turned at another speed, this comparison is of no use; check its speed"
        )
    return OrderVerdict(
        recording=name, baseline=baseline_name, setup=setup, quality=quality, orders=orders, change=change
    )


def _of_drives(orders: OrderVectors) -> Iterator[str]:
    """What lines of gears, motors and the mains do to the comparison."""
    speed_hz = orders.speed_rpm / 60.0
    for drive in orders.drives:
        if drive.kind == "gear":
            yield (
                f"a gear of {drive.teeth} teeth on this shaft meshes at {drive.frequency_hz:.1f} Hz with a "
                f"mate of {drive.mate_teeth} teeth: its lines count as vibration beside the orders"
            )
            continue
        line = f"a line of an induction motor stands out at {drive.frequency_hz:.2f} Hz, twice the mains"
        if drive.frequency_hz == orders.motor_hz:
            order = round(drive.order)
            yield (
                f"{line}: it was taken out of {order}X, {order * speed_hz:.2f} Hz, as it is no fault of the "
                "rotor"
            )
        else:
            yield f"{line}: it counts as vibration beside the orders, and is no fault of the rotor"
    if orders.mains_hz is not None:
        yield (
            f"a line stands out at {orders.mains_hz:.2f} Hz, the mains, as cables pick them up: it counts as "
            "vibration beside the orders, and is no fault of the rotor"
        )
