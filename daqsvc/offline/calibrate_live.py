"""``daqsvc calibrate MACHINE --live``: the healthy machine from its bus, by the detector that watches it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.ring import SampleRing
from daqsvc.detectors.make import detectors
from daqsvc.detectors.rotor_synchronous.detector import RotorSynchronousDetector
from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous
from daqsvc.diagnosis.pipeline import Pipeline
from daqsvc.diagnosis.snapshots import alignment
from daqsvc.rotor.synchronous.baseline import NotCalibratableError
from daqsvc.settings.plugins import configured
from drivers.make import bus_drivers

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.settings import MachineFile
    from daqsvc.settings.section import Section

_LOOK_NS = NS_PER_S // 10
_PATIENCE = 3.0
_START_S = 10.0
_RING_S = 10.0


def default_timeout_s(machine: MachineFile, revolutions: int) -> float:
    """Three times what so many revolutions take, and ten seconds for the bus to come up."""
    return _START_S + _PATIENCE * revolutions * 60.0 / abs(machine.machine.speed_rpm)


async def calibrate_live(
    machine: MachineFile,
    clock: Clock,
    *,
    revolutions: int,
    timeout_s: float,
    progress: Callable[[int, int], None] | None = None,
) -> Calibration:
    """Listen to a healthy machine until enough revolutions were seen.

    May be cancelled at any time; it then leaves no task and no open bus behind.

    Args:
        machine: a machine file with ``[pipeline.rotor_synchronous]``; its ``calibration`` is not examined.
        clock: the service's clock.
        revolutions: usable revolutions to wait for.
        timeout_s: how long to wait for them.
        progress: called now and then with the revolutions seen and the revolutions wanted.

    Raises:
        NotCalibratableError: the machine is not steady, not healthy as far as can be seen, or silent.
        AssemblyError: no driver of that name is installed.
        DeviceAbsentError: the bus is absent and the machine file states that this is an error.
    """
    listener = _Listener(machine, clock, revolutions)
    tasks = [asyncio.create_task(listener.pipeline.run(), name="pipeline")]
    tasks += [asyncio.create_task(driver.run(), name=f"driver {driver.name}") for driver in listener.drivers]
    waiting = asyncio.create_task(listener.wait(timeout_s, progress), name="calibration")
    try:
        pending = {waiting, *tasks}
        while not waiting.done():
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
            for task in done - {waiting}:
                # A driver that is to be ignored if absent may end; nothing may fail unheard.
                task.result()
        return waiting.result()
    finally:
        for task in (waiting, *tasks):
            task.cancel()
        await asyncio.gather(waiting, *tasks, return_exceptions=True)


class _Listener:
    """Drivers, the ring of one stream, and the detector that calibrates on it."""

    def __init__(self, machine: MachineFile, clock: Clock, revolutions: int) -> None:
        self._clock = clock
        self._revolutions = revolutions
        (detector,) = detectors(_only_rotor(machine, revolutions))
        assert isinstance(detector, RotorSynchronousDetector)  # noqa: S101 - the only one left
        self._detector = detector
        settings = machine.pipeline.table(RotorSynchronous)
        assert settings is not None  # noqa: S101 - the command has asked for it
        grid = machine.grid(settings.sampled_together)
        capacity = max(round(_RING_S * grid.rate_hz), 4 * detector.block)
        self._ring = SampleRing(grid.name, grid.channel_names, capacity)
        self._alignment = alignment(machine, clock, self._deliver)
        self._reason = ""
        self.drivers = bus_drivers(machine, clock, self._deliver)
        self.pipeline = Pipeline({detector.stream: self._ring}, [detector], self._report, clock)

    def _deliver(self, block: SampleBlock) -> None:
        if block.stream == self._detector.stream:
            self._ring.write(block)
        self._alignment.accept(block)

    def _report(self, diagnosis: Diagnosis) -> None:
        self._reason = "" if diagnosis.quality == "good" else diagnosis.reason

    async def wait(self, timeout_s: float, progress: Callable[[int, int], None] | None) -> Calibration:
        """Until the detector has calibrated or refused, or time is up."""
        deadline_ns = self._clock.monotonic_ns() + round(timeout_s * NS_PER_S)
        while True:
            watch = self._detector.watch
            if watch.calibration is not None:
                return watch.calibration
            if self._detector.refused:
                raise NotCalibratableError(self._detector.refused)
            if progress is not None:
                progress(min(watch.revolutions, self._revolutions), self._revolutions)
            if self._clock.monotonic_ns() >= deadline_ns:
                raise NotCalibratableError(self._too_late(timeout_s))
            await self._clock.sleep_ns(_LOOK_NS)

    def _too_late(self, timeout_s: float) -> str:
        seen = self._detector.watch.revolutions
        if not self._ring.end_index:
            return (
                f"no samples of {self._detector.stream} came within {timeout_s:g} s; check that the machine "
                "file names the right bus, and that the device sends"
            )
        why = f" ({self._reason})" if self._reason else ""
        return (
            f"{self._revolutions} usable revolutions did not come within {timeout_s:g} s, of {seen} seen{why}"
            "; wait longer with --timeout-s, or ask for fewer with --revolutions"
        )


def _only_rotor(machine: MachineFile, revolutions: int) -> MachineFile:
    """The machine with the calibrated rotor as its only detector, not calibrated yet."""
    settings = machine.pipeline.table(RotorSynchronous)
    assert settings is not None  # noqa: S101 - the command has asked for it
    update: dict[str, Section | None] = {key: None for key, _, _ in configured(machine.pipeline)}
    update["rotor_synchronous"] = settings.model_copy(
        update={"calibration": None, "calibrate_revolutions": revolutions}
    )
    return machine.model_copy(update={"pipeline": machine.pipeline.model_copy(update=update)})
