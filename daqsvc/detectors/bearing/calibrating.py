"""From a recording of a healthy machine to what its bearings are compared with."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.baseline import learn_baseline, resampled
from daqsvc.bearing.race.judge import race_test
from daqsvc.detectors.bearing.build import SAME_RATE, pair_models
from daqsvc.detectors.bearing.kinematics import orders_of
from daqsvc.detectors.bearing.recorded_checks import against_healthy_run
from daqsvc.dsp.quality import RefusedError, UnfitError
from daqsvc.dsp.quality.clipped import refuse_clipped

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daqsvc.bearing.baseline import BearingBaseline
    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.two_sensors import PairModel
    from daqsvc.detectors.bearing.settings import Bearing
    from daqsvc.detectors.bearing.verdict import BearingSetup
    from daqsvc.recording.recording import Recording
    from daqsvc.settings.models import MachineFile


def calibrate_bearings(
    machine: MachineFile, settings: Bearing, recording: Recording, *, together: bool = False
) -> BearingBaseline:
    """The healthy machine of a recording, which must show no fault.

    Args:
        machine: the machine file.
        settings: its bearings.
        recording: of the healthy machine, with all accelerometers. What is faster than the stream of the
            machine is learnt at its rate, as it is compared with the machine's own samples.
        together: whether all accelerometers are compared together, too.

    Raises:
        RefusedError: a bearing shows a fault, or a channel cannot be judged.
        NotIdentifiableError: it cannot be the healthy machine's, or is slower than the machine.
        ValueError: a bearing is not known.
    """
    speed_rpm = abs(machine.machine.speed_rpm)
    orders = {bearing.sensor: orders_of(bearing, index) for index, bearing in enumerate(settings.bearings)}
    _refuse_faults(recording, orders, speed_rpm)
    watched_hz = machine.streams[machine.sensor(settings.bearings[0].sensor).stream].rate_hz
    # Options do not state the rate of a stream: it is that of the recording then.
    rate_hz = watched_hz if abs(recording.rate_hz / watched_hz - 1.0) > SAME_RATE else recording.rate_hz
    groups = [tuple(bearing.sensors) for bearing in settings.bearings]
    if together and len(groups) > 1:
        groups.append(settings.sensors)
    units = {name: machine.sensor(name).unit for name in settings.sensors}
    return _learn(recording, rate_hz, speed_rpm, orders, groups, pair_models(machine, settings), units)


def _learn(
    recording: Recording,
    rate_hz: float,
    speed_rpm: float,
    orders: Mapping[str, BearingOrders],
    groups: Sequence[tuple[str, ...]],
    pairs: Mapping[tuple[str, ...], PairModel] | None = None,
    units: Mapping[str, str] | None = None,
) -> BearingBaseline:
    samples, highest = resampled(recording.samples, recording.rate_hz, rate_hz)
    samples = np.where(np.isfinite(samples), samples, np.nan)
    return learn_baseline(
        dict(zip(recording.names, samples.T, strict=True)),
        rate_hz,
        speed_rpm,
        orders,
        groups,
        pairs=pairs,
        units=units,
        highest=highest,
        source=str(recording.source),
    )


@dataclass(slots=True)
class HealthyRun:
    """A recording of the healthy machine, learnt again for each sampling rate that is compared with it.

    Attributes:
        setup: what it is judged by.
        recording: the healthy machine's.
    """

    setup: BearingSetup
    recording: Recording
    _learnt: dict[float, BearingBaseline] = field(default_factory=dict)
    _against: tuple[str, str] | None = None

    @property
    def against(self) -> tuple[str, str]:
        """The evidence against it as a healthy run, see `against_healthy_run`."""
        if self._against is None:
            self._against = against_healthy_run(self.recording, self.setup)
        return self._against

    def at(self, rate_hz: float) -> BearingBaseline:
        """The healthy machine at a sampling rate.

        Raises:
            NotIdentifiableError: it cannot be learnt at that rate.
        """
        if rate_hz not in self._learnt:
            setup = self.setup
            groups = [(name,) for name in setup.channels] + [setup.channels] * (len(setup.channels) > 1)
            self._learnt[rate_hz] = _learn(self.recording, rate_hz, setup.speed_rpm, setup.bearings, groups)
        return self._learnt[rate_hz]


def _refuse_faults(recording: Recording, bearings: Mapping[str, BearingOrders], speed_rpm: float) -> None:
    """Refuse a machine that is not in good order.

    Raises:
        RefusedError: a bearing shows a fault, or a channel cannot be judged.
    """
    for name, orders in bearings.items():
        column = recording.samples[:, recording.names.index(name)]
        try:
            refuse_clipped(column)
            verdict = race_test(
                np.where(np.isfinite(column), column, np.nan), recording.rate_hz, speed_rpm, orders
            ).verdict
        except UnfitError as error:
            raise RefusedError(f"{recording.source}: {name}: {error}") from None
        if verdict != "normal":
            damage = "ball" if verdict == "ball" else f"{verdict.replace('_', ' ')} race"
            raise RefusedError(
                f"{recording.source}: {name} shows {damage} damage: this is no machine in good order; give a "
                "recording of one"
            )
