"""From a machine file to its outputs."""

from __future__ import annotations

import logging
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

from daqsvc.alarms.expected import handling_conditions
from daqsvc.detectors.make import plugins
from daqsvc.errors.code import coded, with_code
from daqsvc.publish.mqtt.settings import Mqtt
from daqsvc.publish.output import OutputSet, Watched
from daqsvc.settings.alarms import DiagnosisAlarm
from daqsvc.settings.hooks import PluginFailedError, failing_in
from daqsvc.settings.plugins import configured_outputs, output_tables

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from daqsvc.publish.output import Output, OutputPort
    from daqsvc.publish.plugin import OutputPlugin
    from daqsvc.settings.alarms import Alarm
    from daqsvc.settings.models import MachineFile

log = logging.getLogger(__name__)


def output_plugins() -> dict[str, OutputPlugin[Any]]:
    """The kinds of outputs that are installed, by the path of their table."""
    return cast("dict[str, OutputPlugin[Any]]", dict(output_tables()))


def output_set(
    machine: MachineFile, conditions: Iterable[str] = (), others: Iterable[MachineFile] = ()
) -> OutputSet:
    """The outputs that a machine file asks for.

    Args:
        machine: the machine file.
        conditions: names of what the service may report about itself, outputs aside.
        others: machine files of the same box, whose machines they report, too.
    """
    installed, tables = output_plugins(), {path: tables for path, _, tables in configured_outputs(machine)}
    own: list[str] = []
    for path, table in tuple(tables.items()):
        with _left_out(tables, path):
            own += installed[path].conditions(table)
    outdated = [plugin.outdated for path, plugin in installed.items() if path not in tables]

    def make(port: OutputPort) -> dict[str, Output]:
        made: dict[str, Output] = {}
        for path, table in tuple(tables.items()):
            with _left_out(tables, path):
                output = installed[path].build(machine, table, port)
                if output is not None:
                    made[path] = output
        return made

    return OutputSet(
        machines={
            **{other.machine.name: watched(other) for other in others},
            machine.machine.name: watched(machine, (*conditions, *own)),
        },
        make=make,
        topic_root=topic_root(machine),
        conditions=tuple(own),
        outdated={prefix: words for each in outdated for prefix, words in each.items()},
    )


def topic_root(machine: MachineFile) -> str:
    """The first level of all topics, under which the journal keeps its messages."""
    mqtt = machine.output(Mqtt)
    root: str = Mqtt.model_fields["topic_root"].default if mqtt is None else mqtt.topic_root
    return root


@contextmanager
def _left_out(settings: dict[str, Any], path: str) -> Iterator[None]:
    """Go on without an output that fails: whatever a plugin does, the machine is watched."""
    try:
        yield
    except PluginFailedError as failed:
        del settings[path]
        words = f"output {path} cannot be made and is left out: {failed.words}"
        log.error("%s", with_code(words, failed.code), extra=coded(failed.code))  # noqa: TRY400


def check_outputs(machine: MachineFile) -> None:
    """Ask the plugins all that they are asked before an output is made.

    Raises:
        AssemblyError: one fails.
    """
    with failing_in(machine.path):
        for path, _, settings in configured_outputs(machine):
            tuple(output_plugins()[path].conditions(settings))
        watched(machine, spared=False)


def watched(machine: MachineFile, conditions: Iterable[str] = (), *, spared: bool = True) -> Watched:
    """What there is to report about a machine.

    Args:
        machine: the machine file.
        conditions: names of what the service may report about itself.
        spared: whether a detector's plugin that fails is logged and left out, and the others are asked.

    Raises:
        AssemblyError: one fails, and is not spared.
    """
    return Watched(
        machine.machine.name,
        machine.machine.description,
        alarms=tuple(alarm.name for alarm in machine.alarms),
        services=(
            *_asked(machine, "quality_alarms", spared=spared),
            *handling_conditions(machine.alarm_handling),
            *conditions,
        ),
        readings=tuple(_asked(machine, "readings", spared=spared)),
        findings=machine.detectors,
        rests_on={alarm.name: tuple(_rests_on(alarm)) for alarm in machine.alarms},
        buses=tuple(machine.buses),
        rates_hz={name: stream.rate_hz for name, stream in machine.streams.items()},
    )


def _rests_on(alarm: Alarm) -> Iterator[str]:
    """The alarms about sensors and detectors without which nobody can state that this one is not raised."""
    if isinstance(alarm, DiagnosisAlarm):
        yield f"detector-ok/{alarm.detector}"
    else:
        for sensor in alarm.watched:
            yield from (f"sensor-ok/{sensor}", f"detector-ok/levels/{sensor}")


def _asked(machine: MachineFile, hook: str, *, spared: bool) -> Iterator[Any]:
    """What the plugins of a machine's detectors answer at a hook."""
    for plugin, settings in plugins(machine):
        try:
            yield from getattr(plugin, hook)(machine, settings)
        except PluginFailedError as failed:
            if not spared:
                raise
            log.error("%s", failed.followed_by("; the service goes on without"), extra=coded(failed.code))  # noqa: TRY400
