"""What the sensors of a machine file see of a simulated plant, or of a measured recording."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

import numpy as np

from daqsvc.errors.command_line import SIMULATION
from sim_hw.plants.rotor import RotorEscapeError
from sim_hw.scenario import BearingScenario, Scenario, ScenarioRun

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.recording.recording import Recording
    from daqsvc.settings import MachineFile
    from daqsvc.settings.sensors import BaseSensor


logger = logging.getLogger(__name__)

G_M_S2 = 9.80665
_PER_UM = {"um": 1.0, "mm": 1e-3, "mil": 1.0 / 25.4}
_PER_M_S2 = {"m/s2": 1.0, "g": 1.0 / G_M_S2, "mm/s2": 1e3, "mg": 1e3 / G_M_S2}


class SignalError(ValueError):
    """What is to be played has nothing for a sensor; states which, and what there is."""

    code = SIMULATION


class Signals(Protocol):
    """A source of samples for any sensor that it knows."""

    def of(self, sensor: BaseSensor, rate_hz: float) -> NDArray[np.float64]:
        """What a sensor states: float64 ``[n]`` in the sensor's unit.

        Raises:
            SignalError: there is nothing for this sensor.
        """
        ...


ScenarioT = TypeVar("ScenarioT")
RunT = TypeVar("RunT")


class _ScenarioSignals(Generic[ScenarioT, RunT]):
    """A scenario, simulated once for each sampling rate.

    Args:
        scenario: what happens to the machine.
        duration_s: length of the run, instead of the scenario's.
        seed: instead of the scenario's.
        snr_db: instead of that of the scenario, or of its plant.
    """

    def __init__(
        self,
        scenario: ScenarioT,
        duration_s: float | None = None,
        seed: int | None = None,
        snr_db: float | None = None,
    ) -> None:
        self._scenario, self._duration_s, self._seed, self._snr_db = scenario, duration_s, seed, snr_db
        self._runs: dict[float, RunT] = {}
        self._seen: list[str] = []

    def _place(self, sensor: BaseSensor) -> int:
        """The place of a sensor in the order in which they were asked for, from 0."""
        if sensor.name not in self._seen:
            self._seen.append(sensor.name)
        return self._seen.index(sensor.name)


class RotorSignals(_ScenarioSignals[Scenario, "dict[str, NDArray[np.float64]]"]):
    """Proximity probes and keyphasor of a rotor; probes without an angle point to +x, then to +y."""

    def of(self, sensor: BaseSensor, rate_hz: float) -> NDArray[np.float64]:
        """See `Signals.of`."""
        kind = getattr(sensor, "type", "")
        if kind not in {"keyphasor", "proximity"}:
            raise SignalError(
                f"sensor {sensor.name!r} is of type {kind!r}, and a rotor scenario gives proximity probes "
                "and keyphasors; choose the streams that hold those with --stream, or play a --recording"
            )
        speed_rpm = self._scenario.plant.speed_rpm
        if rate_hz <= speed_rpm / 30.0:
            raise SignalError(
                f"stream {sensor.stream!r} is sampled at {rate_hz:g} Hz, too slowly to see a shaft turn at "
                f"{speed_rpm:g} rpm; set its rate_hz above {speed_rpm / 30.0:g}, or play a --recording"
            )
        channels = self._run(rate_hz)
        if kind == "keyphasor":
            return channels["keyphasor_v"]
        place, stated = self._place(sensor), getattr(sensor, "angle_deg", None)
        angle = math.radians(90.0 * (place % 2) if stated is None else stated)
        displacement_um = math.cos(angle) * channels["x_um"] + math.sin(angle) * channels["y_um"]
        return displacement_um * _PER_UM[getattr(sensor, "unit", "um")]

    def _run(self, rate_hz: float) -> dict[str, NDArray[np.float64]]:
        if rate_hz not in self._runs:
            speed_hz = self._scenario.plant.speed_rpm / 60.0
            revolutions = self._scenario.revolutions
            if self._duration_s is not None:
                revolutions = self._duration_s * self._scenario.plant.speed_rpm / 60.0
            onsets = tuple(
                onset
                for onset in self._scenario.onset
                if onset.at_rev + self._scenario.dither_rev < revolutions
            )
            run = Scenario.model_validate(
                {
                    **self._scenario.model_dump(),
                    "samples_per_rev": rate_hz / speed_hz,
                    "revolutions": revolutions,
                    "onset": [onset.model_dump() for onset in onsets],
                }
            )
            try:
                self._runs[rate_hz] = run.simulate(self._seed, self._snr_db).channels
            except RotorEscapeError as error:
                raise SignalError(f"scenario {self._scenario.title!r} cannot be played: {error}") from error
        return self._runs[rate_hz]


class BearingSignals(_ScenarioSignals[BearingScenario, ScenarioRun]):
    """Accelerometers of a machine with a bearing: the first on the rotor's side, others on the housing."""

    def of(self, sensor: BaseSensor, rate_hz: float) -> NDArray[np.float64]:
        """See `Signals.of`."""
        kind = getattr(sensor, "type", "")
        if kind != "accelerometer":
            raise SignalError(
                f"sensor {sensor.name!r} is of type {kind!r}, and a bearing scenario gives accelerometers; "
                "choose the streams that hold those with --stream, or play a --recording"
            )
        if rate_hz not in self._runs:
            scenario, duration_s = self._scenario, self._duration_s
            if duration_s is not None:
                kept = tuple(damage for damage in scenario.damage if damage.at_s < duration_s)
                scenario = scenario.model_copy(update={"duration_s": duration_s, "damage": kept})
            self._runs[rate_hz] = scenario.accelerations(rate_hz, self._seed, self._snr_db)
        run, on_rotor = self._runs[rate_hz], self._place(sensor) == 0
        return (run.rotor_m_s2 if on_rotor else run.housing_m_s2) * _PER_M_S2[getattr(sensor, "unit", "m/s2")]


class RecordedSignals:
    """Channels of a recording, each for the sensor (or the stream's channel) of the same name.

    Args:
        recording: in the sensors' units. It is played again from its beginning as often as it takes. NaN is
            sent as what the layout has for a value that is not there, or refused if it has nothing.
            A stream of another rate gets it resampled: one machine has streams of several rates.
        duration_s: how long to play; once through unless given.

    Raises:
        SignalError: the recording holds infinite samples.
    """

    def __init__(self, recording: Recording, duration_s: float | None = None) -> None:
        if recording.infinity_count:
            raise SignalError(
                f"{recording.source} holds infinite samples, which no device could send; cut them out or "
                "interpolate them"
            )
        self._recording = recording
        self._duration_s = len(recording.samples) / recording.rate_hz if duration_s is None else duration_s
        self._resampled: set[str] = set()

    def of(self, sensor: BaseSensor, rate_hz: float) -> NDArray[np.float64]:
        """See `Signals.of`."""
        names = self._recording.names
        name = next((name for name in (sensor.name, sensor.channel) if name in names), None)
        if name is None:
            raise SignalError(
                f"{self._recording.source} has no channel for sensor {sensor.name!r} (channel "
                f"{sensor.channel!r}); it gives {', '.join(names)}: name them with --map SENSOR=VARIABLE,..."
            )
        column = self._recording.samples[:, names.index(name)]
        if not math.isclose(rate_hz, self._recording.rate_hz, rel_tol=1e-3):
            self._say_resampled(sensor.stream, rate_hz)
            column = resampled(column, self._recording.rate_hz, rate_hz)
        return np.resize(column, max(round(self._duration_s * rate_hz), 1))

    def _say_resampled(self, stream: str, rate_hz: float) -> None:
        if stream not in self._resampled:
            self._resampled.add(stream)
            logger.warning(
                "stream %r is sampled at %g Hz and %s at %g Hz: it is resampled. If the recording's rate is "
                "wrong, state the right one with --fs",
                stream,
                rate_hz,
                self._recording.source,
                self._recording.rate_hz,
            )


def resampled(column: NDArray[np.float64], from_hz: float, to_hz: float) -> NDArray[np.float64]:
    """A channel at another rate, band-limited to the lower one; where samples were missing they still are.

    Args:
        column: float64 ``[n]``; NaN where a sample is missing.
        from_hz: its rate.
        to_hz: the rate wanted.

    Returns:
        float64 ``[ceil(n * to_hz / from_hz)]``, to a rate that differs from the one wanted by 1e-6 at most.
    """
    from scipy.signal import resample_poly  # noqa: PLC0415 - a second to import, seldom needed

    ratio = Fraction(to_hz / from_hz).limit_denominator(10_000)
    missing = np.isnan(column)
    whole = column.copy()
    if missing.all():
        whole[:] = 0.0
    elif missing.any():
        there = np.flatnonzero(~missing)
        whole[missing] = np.interp(np.flatnonzero(missing), there, column[there])
    # Padded by a line: a channel that stands far from zero, such as a gap voltage, must not ring at its ends.
    moved = resample_poly(whole, ratio.numerator, ratio.denominator, padtype="line")
    taken_at = np.minimum(np.round(np.arange(len(moved)) / float(ratio)).astype(np.int64), len(column) - 1)
    moved[missing[taken_at]] = np.nan
    return np.asarray(moved, np.float64)


@dataclass(frozen=True, slots=True)
class StreamSamples:
    """What is played as one stream.

    Attributes:
        stream: its name in the machine file.
        rate_hz: samples per second.
        samples: ``[n, channels]`` in the sensors' units; a channel that no sensor has is 0.
    """

    stream: str
    rate_hz: float
    samples: NDArray[np.float64]


def stream_samples(machine: MachineFile, stream: str, signals: Signals) -> StreamSamples:
    """What is to be played as one stream of a machine.

    Raises:
        SignalError: there is nothing for one of its sensors, or it has none.
    """
    described = machine.streams[stream]
    by_channel = {sensor.channel: sensor for sensor in machine.sensors if sensor.stream == stream}
    columns = {
        name: signals.of(by_channel[name], described.rate_hz)
        for name in described.layout.channel_names
        if name in by_channel
    }
    if not columns:
        raise SignalError(f"stream {stream!r} has no sensor; leave it out by naming the others with --stream")
    length = min(map(len, columns.values()))
    silent = np.zeros(length)
    samples = np.column_stack([columns.get(name, silent)[:length] for name in described.layout.channel_names])
    return StreamSamples(stream, described.rate_hz, samples)
