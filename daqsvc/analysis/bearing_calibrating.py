"""From a recording of a healthy machine to what its bearings' detectors compare with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.analysis.bearing_machine import present
from daqsvc.analysis.machine import MachineAnalyst
from daqsvc.analysis.setup import RefusedError
from daqsvc.bearing.identify_baseline import learn_baseline, resampled
from daqsvc.bearing.race.judge import race_test
from daqsvc.detectors.bearing.build import SAME_RATE, orders_of, pair_models
from daqsvc.detectors.bearing.settings import Bearing
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.clipped import ClippedError, refuse_clipped

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.analysis.bearing_setup import BearingSetup
    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.identify_baseline import BearingBaseline
    from daqsvc.recording.recording import Recording
    from daqsvc.settings.models import MachineFile


def learn_by_setup(setup: BearingSetup, path: str) -> BearingBaseline:
    """Learn from a recording what options say about it.

    Raises:
        RecordingError: it cannot be read.
        RefusedError: it shows a fault.
        NotIdentifiableError: it cannot be the healthy machine's.
    """
    recording = setup.load(path)
    _refuse_faults(recording, setup.bearings, setup.speed_rpm)
    return setup.learn(recording)


def learn_by_machine(
    machine: MachineFile, path: str, channels: Mapping[str, str], rate_hz: float | None
) -> BearingBaseline:
    """Learn from a recording of a machine that has a machine file with ``[pipeline.bearing]``.

    Args:
        machine: the machine file.
        path: the recording.
        channels: which variable of it is which sensor or channel.
        rate_hz: its sampling rate; None: what it says. What is faster than the machine is learnt at its rate.

    Raises:
        ValueError: the map names what is no sensor, or a bearing is not known.
        RecordingError: the recording cannot be read.
        RefusedError: it lacks an accelerometer, or shows a fault.
        NotIdentifiableError: it cannot be the healthy machine's, or is slower than the machine.
    """
    analyst = MachineAnalyst(machine=str(machine.path), channels=channels, rate_hz=rate_hz)
    analyst.check_map(machine)
    given = machine.pipeline.table(Bearing)
    assert given is not None  # noqa: S101 - the command has asked for it
    recording = analyst.load(machine, path, given.sensors)
    watched = present(given, recording.names)
    assert watched is not None  # noqa: S101 - none is lacking
    bearings = {bearing.sensor: orders_of(bearing, i) for i, bearing in enumerate(watched.bearings)}
    speed_rpm = abs(machine.machine.speed_rpm)
    _refuse_faults(recording, bearings, speed_rpm)
    # What is learnt is compared with the machine's own samples.
    watched_hz = machine.streams[machine.sensor(watched.bearings[0].sensor).stream].rate_hz
    rate_hz = recording.rate_hz if abs(recording.rate_hz / watched_hz - 1.0) <= SAME_RATE else watched_hz
    samples, highest = resampled(recording.samples, recording.rate_hz, rate_hz)
    samples = np.where(np.isfinite(samples), samples, np.nan)
    return learn_baseline(
        dict(zip(recording.names, samples.T, strict=True)),
        rate_hz,
        speed_rpm,
        bearings,
        [bearing.sensors for bearing in watched.bearings],
        pairs=pair_models(machine, watched),
        highest=highest,
        source=str(recording.source),
    )


def _refuse_faults(recording: Recording, bearings: Mapping[str, BearingOrders], speed_rpm: float) -> None:
    """Refuse a machine that is not in good order.

    Raises:
        RefusedError: a bearing shows a fault, or a channel cannot be judged.
    """
    for name, orders in bearings.items():
        column = recording.samples[:, recording.names.index(name)]
        try:
            refuse_clipped(column)
            said = race_test(
                np.where(np.isfinite(column), column, np.nan), recording.rate_hz, speed_rpm, orders
            )
        except (ClippedError, UnfitError) as error:
            raise RefusedError(f"{recording.source}: {name}: {error}") from None
        if said.verdict != "normal":
            damage = "ball" if said.verdict == "ball" else f"{said.verdict.replace('_', ' ')} race"
            raise RefusedError(
                f"{recording.source}: {name} shows {damage} damage: this is no machine in good order; give a "
                "recording of one"
            )
