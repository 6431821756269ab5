"""From the figures of the service to metrics, as Prometheus names them: base units, counters with ``_total``.

Every label has the values that the machine file or the program gives it, and no others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily

from daqsvc import __version__
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.publish.faults import fault_counts

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from prometheus_client.metrics_core import Metric

    from daqsvc.diagnosis.reading import Reading
    from daqsvc.diagnosis.record import Diagnosis

    Figures = Mapping[str, Any]
    Values = Mapping[Any, float]
    """By the values of the labels after the first one."""

_FAULTS = {"streams": "stream", "buses": "bus", "detectors": "detector"}
_OF_MACHINES = frozenset({"streams", "detectors"})
_OF_SERVICE = frozenset({"buses", "outbox", "telemetry"})
_STATES = ("active", "unacknowledged", "latched", "suppressed", "shelved", "out_of_service")


class _Maker:
    """Makes metrics of one machine.

    Args:
        machine: its name, the first label of all.
    """

    def __init__(self, machine: str) -> None:
        self._machine = machine

    def gauge(self, name: str, words: str, values: Values, *labels: str) -> Metric:
        """A value that goes up and down, for each tuple of values of the labels."""
        family = GaugeMetricFamily(f"daqsvc_{name}", words, labels=("machine", *labels))
        for key, value in values.items():
            family.add_metric((self._machine, *key), value)
        return family

    def count(self, name: str, words: str, values: Values, *labels: str) -> Metric:
        """A value that only grows, for each tuple of values of the labels."""
        family = CounterMetricFamily(f"daqsvc_{name}", words, labels=("machine", *labels))
        for key, value in values.items():
            family.add_metric((self._machine, *key), value)
        return family


def merged(metrics: Iterable[Metric]) -> list[Metric]:
    """Metrics of several machines: those of one name are one, with the samples of all."""
    families: dict[str, Metric] = {}
    for metric in metrics:
        families.setdefault(metric.name, metric)
        if families[metric.name] is not metric:
            families[metric.name].samples += metric.samples
    return [*families.values()]


def machine_metrics(machine: str, figures: Figures, rates_hz: Mapping[str, float]) -> Iterator[Metric]:
    """The metrics of the streams, detectors and alarms of a machine.

    Args:
        machine: name of the machine.
        figures: as in `StatusPayload`, by the names of its machine file.
        rates_hz: by stream, what the machine file states.
    """
    make = _Maker(machine)
    yield from _streams(make, figures["streams"], rates_hz)
    yield from _detectors(make, figures["detectors"])
    yield from _fault_metrics(make, figures, _OF_MACHINES)
    yield from _alarms(make, figures["alarms"])


def service_metrics(machine: str, figures: Figures, oldest_age_s: float | None) -> Iterator[Metric]:
    """The metrics of the service itself.

    Args:
        machine: name of the machine, or of what represents the service if there are several.
        figures: as in `StatusPayload`.
        oldest_age_s: age of the oldest alarm event that waits for the broker; None if none does.
    """
    make = _Maker(machine)
    info = InfoMetricFamily("daqsvc_build", "The program.", labels=("machine",))
    info.add_metric((machine,), {"version": __version__})
    yield info
    yield make.gauge("bus_up", "Whether the bus is up.", _each(figures["buses"], "up"), "bus")
    yield from _fault_metrics(make, figures, _OF_SERVICE)
    yield from _outbox(make, figures["outbox"], oldest_age_s)
    if "connected" in (mqtt := figures.get("mqtt", {})):
        yield from _broker(make, mqtt)
    lag = figures["loop_lag_ms"]
    words = "Lateness of the event loop within the last minute"
    yield make.gauge("event_loop_lag_p99_seconds", f"{words}: 99th percentile.", {(): lag["p99"] / 1000})
    yield make.gauge("event_loop_lag_max_seconds", f"{words}: maximum.", {(): lag["max"] / 1000})
    words = "How often the process did not run for more than a second."
    yield make.count("suspensions", words, {(): figures["suspensions"]})
    words = "How often a part of the service has failed and was started again."
    yield make.count("part_failures", words, {(): sum(figures["failures"].values())})
    commands = {(outcome,): figures["commands"][outcome] for outcome in ("accepted", "refused")}
    yield make.count("commands", "What people asked of alarms.", commands, "outcome")


def reading_metrics(
    machine: str, readings: Sequence[Reading], statements: Mapping[str, tuple[Diagnosis, float] | None]
) -> Iterator[Metric]:
    """The metrics of the last statements of detectors.

    Args:
        machine: name of the machine.
        readings: the figures that are metrics.
        statements: by detector the last one, and when, s since the Unix epoch; None before the first one.
    """
    make = _Maker(machine)
    spoken = {name: pair for name, pair in statements.items() if pair is not None}
    words = "Whether the last statement of the detector rests on good samples of sensors that are OK."
    good = {(name,): float(statement.quality == "good") for name, (statement, _) in spoken.items()}
    yield make.gauge("detector_good", words, good, "detector")
    words = "When the detector made its last statement."
    spoke = {(name,): at_s for name, (_, at_s) in spoken.items()}
    yield make.gauge("detector_last_statement_timestamp_seconds", words, spoke, "detector")
    values: dict[tuple[str, ...], float] = {}
    for reading in readings:
        pair = spoken.get(reading.detector)
        value = None if pair is None else getattr(pair[0], reading.kind).get(reading.key)
        if value is not None:
            values[reading.detector, reading.kind, reading.key, reading.unit] = float(value)
    words = "A figure of the detector's last statement, in the unit of the label; none if it has none."
    yield make.gauge("reading", words, values, "detector", "kind", "reading", "unit")


def health_metric(machine: str, *, is_healthy: bool) -> Metric:
    """What ``/healthz`` reports, as a metric."""
    words = "Whether acquisition, detectors and outbox work, as /healthz states."
    return _Maker(machine).gauge("healthy", words, {(): float(is_healthy)})


def _each(things: Figures, key: str, per: float = 1.0) -> dict[tuple[str, ...], float]:
    return {(name,): counted[key] / per for name, counted in things.items()}


def _streams(make: _Maker, streams: Figures, rates_hz: Mapping[str, float]) -> Iterator[Metric]:
    def count(name: str, words: str, key: str) -> Metric:
        return make.count(f"stream_{name}", words, _each(streams, key), "stream")

    def gauge(name: str, words: str, values: Values) -> Metric:
        return make.gauge(f"stream_{name}", words, values, "stream")

    yield count("frames_received", "Frames of the right length that arrived.", "frames_received")
    yield count("samples_received", "Samples that went on to the detectors.", "samples_received")
    yield count("samples_lost", "Samples that were lost, as they never came.", "samples_lost")
    settled = {name: one for name, one in streams.items() if one["time_settled"]}
    yield gauge("rate_hertz", "The device's own rate, measured, once known.", _each(settled, "rate_hz"))
    yield gauge(
        "configured_rate_hertz",
        "The sampling rate in the machine file.",
        {(n,): hz for n, hz in rates_hz.items()},
    )
    yield gauge(
        "jitter_seconds", "How late frames arrive: the 95th percentile.", _each(streams, "jitter_ms", 1000.0)
    )
    doubted = {(name,): float(bool(one["doubt"])) for name, one in streams.items()}
    yield gauge("doubted", "Whether the samples are doubtful, so that nothing is judged by them.", doubted)


def _detectors(make: _Maker, detectors: Figures) -> Iterator[Metric]:
    def count(name: str, words: str, key: str, per: float = 1.0) -> Metric:
        return make.count(f"detector_{name}", words, _each(detectors, key, per), "detector")

    yield count("windows", "Windows of samples that were processed.", "windows")
    yield count("samples", "Samples in the windows that were processed.", "samples")
    yield count("busy_seconds", "Time that its kernels took.", "busy_ns", NS_PER_S)


def _fault_metrics(make: _Maker, figures: Figures, kinds: Collection[str]) -> Iterator[Metric]:
    counts: dict[str, dict[tuple[str, ...], float]] = {}
    for fault in fault_counts(figures):
        if fault.kind not in kinds:
            continue
        name = (fault.name,) if fault.kind in _FAULTS else ()
        counts.setdefault(fault.kind, {})[(*name, fault.cause)] = fault.times
    for kind, values in counts.items():
        labels = (*((_FAULTS[kind],) if kind in _FAULTS else ()), "cause")
        words = "What was lost or went wrong, by cause."
        yield make.count(f"{_FAULTS.get(kind, kind)}_faults", words, values, *labels)


def _alarms(make: _Maker, alarms: Figures) -> Iterator[Metric]:
    words = "Alarms by state; an active one may be unacknowledged, too."
    yield make.gauge("alarms", words, {(state,): alarms[state] for state in _STATES}, "state")
    yield make.count("alarm_events", "Alarm events.", {(): alarms["events"]})
    yield make.count(
        "alarm_annunciations", "Alarm events that call for a person.", {(): alarms["annunciations"]}
    )
    words = "How often alarms came faster than a person can attend to."
    yield make.count("alarm_floods", words, {(): alarms["floods"]})


def _outbox(make: _Maker, outbox: Figures, oldest_age_s: float | None) -> Iterator[Metric]:
    words = "Alarm events on disk that the broker has not acknowledged."
    yield make.gauge("outbox_events", words, {(): outbox["depth"]})
    words = "Alarm events in memory that are not on disk yet."
    yield make.gauge("outbox_memory_events", words, {(): outbox["waiting"]})
    words = "Age of the oldest alarm event that waits for the broker; 0 if none does."
    yield make.gauge("outbox_oldest_age_seconds", words, {(): oldest_age_s or 0.0})
    words = "Whether the journal takes alarm events."
    yield make.gauge("outbox_writable", words, {(): float(not (outbox["shut"] or outbox["unbacked"]))})
    yield make.count("outbox_appended", "Alarm events committed.", {(): outbox["appended"]})
    yield make.count("outbox_sent", "Alarm events that the broker has taken.", {(): outbox["sent"]})
    words = "Messages of telemetry kept for the broker."
    yield make.gauge("telemetry_messages", words, {(): outbox["telemetry"]["depth"]})


def _broker(make: _Maker, mqtt: Figures) -> Iterator[Metric]:
    words = "Whether the broker is connected."
    yield make.gauge("broker_connected", words, {(): mqtt["connected"]})
    yield make.count("broker_connections", "Connections made.", {(): mqtt["connections"]})
    if certificates := mqtt.get("certificates"):
        words = "When the certificate ends."
        ends = _each(certificates, "not_after_seconds")
        yield make.gauge("certificate_expiry_timestamp_seconds", words, ends, "certificate")
