"""The page of all metrics for Prometheus, with their help texts as they are served."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from prometheus_client import ProcessCollector

from daqsvc.diagnosis.reading import Reading
from daqsvc.publish.metrics.families import health_metric, machine_metrics, reading_metrics, service_metrics
from daqsvc.reference.markdown import code, page, table
from daqsvc.reference.samples import services

if TYPE_CHECKING:
    from collections.abc import Iterator

    from prometheus_client.metrics_core import Metric


def metrics() -> dict[str, tuple[Metric, tuple[str, ...]]]:
    """Every metric by the name that it is asked for by, with its labels."""
    by_name: dict[str, tuple[Metric, tuple[str, ...]]] = {}
    for metric in _made():
        for sample in metric.samples:
            by_name.setdefault(sample.name, (metric, tuple(sample.labels)))
    return by_name


def _made() -> Iterator[Metric]:
    for service in services():
        figures: dict[str, Any] = service.figures()
        name = service.box.own.machine.name
        for stream in figures["streams"].values():
            stream["time_settled"] = 1
        if "connected" in (mqtt := figures.get("mqtt", {})):
            mqtt["certificates"] = {"client": {"not_after_seconds": 0}}
        yield from machine_metrics(name, figures, dict.fromkeys(figures["streams"], 1.0))
        yield from service_metrics(name, figures, 0.0)
    reading = Reading("levels/probe-x", "statistics", "rms", "um")
    statement: Any = SimpleNamespace(quality="good", statistics={"rms": 1.0}, probabilities={})
    yield from reading_metrics("machine", [reading], {"levels/probe-x": (statement, time.time())})
    yield health_metric("machine", is_healthy=True)
    yield from ProcessCollector(registry=None).collect()


def gaps() -> Iterator[str]:
    """Metrics without a help text."""
    for name, (metric, _) in metrics().items():
        if not metric.documentation:
            yield f"metric {name} has no help text: daqsvc.publish.metrics.families"


def pages() -> dict[str, str]:
    """Text of each page, by file name."""
    rows = [
        (
            f'<a id="{name}"></a>{code(name)}',
            metric.type,
            ", ".join(map(code, labels)),
            metric.documentation,
        )
        for name, (metric, labels) in metrics().items()
    ]
    return {
        "metrics.md": page(
            "Metrics for Prometheus", _ABOUT, table(("metric", "type", "labels", "help"), rows)
        )
    }


_ABOUT = """Every metric of `http://127.0.0.1:9464/metrics`, which a table `[metrics]` in the machine file
serves ([keys-metrics.md](keys-metrics.md)). The words are the `HELP` texts. A value of the label `cause` is
the last part of a counter in [counters.md](counters.md). How to scrape them, and rules for alerts:
[status.md](../status.md#metrics-for-prometheus)."""
