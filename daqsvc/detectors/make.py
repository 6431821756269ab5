"""From a machine file to its detectors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from daqsvc.errors.machine_file import PLUGIN_FAILED
from daqsvc.settings.failures import BrokenContractError
from daqsvc.settings.hooks import PluginFailedError, failing_in
from daqsvc.settings.plugins import configured
from daqsvc.settings.problems import AssemblyError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.plugin import DetectorPlugin
    from daqsvc.settings.models import MachineFile


def plugins(machine: MachineFile) -> Iterator[tuple[DetectorPlugin[Any], Any]]:
    """The kinds of detectors that a machine file has a table for, each with its table."""
    for _, plugin, settings in configured(machine.pipeline):
        yield cast("DetectorPlugin[Any]", plugin), settings


def detectors(machine: MachineFile, store: Path | None = None) -> list[Detector]:
    """Every detector that the pipeline section asks for.

    Args:
        machine: the machine file.
        store: directory of the state that survives restarts; None to begin without any and leave none.

    Raises:
        AssemblyError: a calibration that the machine file names cannot be used, or a plugin fails, or makes a
            detector under a name that no alarm can follow, or none although an alarm follows it.
    """
    made: dict[str, Detector] = {}
    streams = {*machine.streams, *(grid.name for grid in machine.grids)}
    for plugin, settings in plugins(machine):
        with failing_in(machine.path):
            built = list(plugin.build(machine, settings, store))
            for detector in built:
                if detector.stream not in streams or detector.block < 1:
                    takes = f"its {detector.name} takes {detector.block} samples of {detector.stream!r}"
                    words = f"{takes}; have it take 1 or more of a stream: {', '.join(sorted(streams))}"
                    raise PluginFailedError(plugin, "build", BrokenContractError(None, words))
        followed = [one.name for one in machine.alarms if getattr(one, "detector", None) == plugin.detector]
        if not built and plugin.detector is not None and followed:
            raise AssemblyError(
                f"the plugin of {plugin.detector!r} makes no detector, and alarm {followed[0]!r} follows it; "
                "remove the alarm, or have the plugin make one",
                code=PLUGIN_FAILED,
            )
        for detector in built:
            if detector.name in made:
                raise AssemblyError(
                    f"two detectors are named {detector.name!r}; have the plugin number them",
                    code=PLUGIN_FAILED,
                )
            named = plugin.detector
            if named is not None and detector.name.partition("/")[0] != named.partition("/")[0]:
                raise AssemblyError(
                    f"the plugin of {named!r} makes a detector {detector.name!r}, which no alarm follows; "
                    f"name it {named!r}, or set `detector` of the plugin",
                    code=PLUGIN_FAILED,
                )
            made[detector.name] = detector
    return list(made.values())


def change_setpoints(machine: MachineFile, running: Iterable[Detector]) -> None:
    """Have the detectors of a machine judge by the setpoints of its file, which was read again.

    Raises:
        AssemblyError: a plugin fails.
    """
    for plugin, settings in plugins(machine):
        with failing_in(machine.path):
            plugin.change_setpoints(machine, settings, running)


def check_files(machine: MachineFile) -> None:
    """See whether the calibrations that a machine file names can be used, and its bearings are known.

    Raises:
        AssemblyError: one cannot, or is not, or a plugin fails; the message names file, key and remedy.
    """
    with failing_in(machine.path):
        for plugin, settings in plugins(machine):
            plugin.check_files(machine, settings)
