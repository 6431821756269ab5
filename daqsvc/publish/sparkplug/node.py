"""What an edge node reports, and in which order; without a broker, a clock or a disk.

The rules of Sparkplug 3.0 for the order of births, data and deaths are kept here and nowhere else: a message
that would break them cannot be made.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.publish.sparkplug.codec import DataType, Metric, Payload, PayloadError, decode, encode

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

NAMESPACE = "spBv1.0"
BDSEQ = "bdSeq"
REBIRTH = "Node Control/Rebirth"
NUMBERS = 256
"""Sequence numbers and birth-death numbers go round from 255 to 0."""

_FORBIDDEN = re.compile(r"[+/#]")


class OrderError(RuntimeError):
    """Something was to be sent before its birth, or a metric that no birth has named."""


class Publication(NamedTuple):
    """A message to be published, not retained.

    Attributes:
        topic: MQTT topic.
        payload: the bytes.
        qos: quality of service.
    """

    topic: str
    payload: bytes
    qos: int = 0


class EdgeNode:
    """The messages of one edge node.

    Aliases are given once and kept: the same metric has the same number in every session of the process.

    Args:
        group: Sparkplug group id.
        name: edge node id.

    Raises:
        ValueError: an id that a Sparkplug topic cannot hold.
    """

    def __init__(self, group: str, name: str) -> None:
        for what, word in (("group", group), ("edge node", name)):
            _check(what, word)
        self._group = group
        self._name = name
        self._seq = 0
        self._aliases: dict[tuple[str | None, str], int] = {}
        self._names: dict[int, tuple[str | None, str]] = {}
        self._born: dict[str | None, frozenset[str]] = {}

    @property
    def commands(self) -> str:
        """Topic on which hosts ask this node for something."""
        return self._topic("NCMD", None)

    @property
    def device_commands(self) -> str:
        """Topic filter for what hosts ask of its devices."""
        return self._topic("DCMD", "+")

    def command_topic(self, device: str) -> str:
        """Topic on which hosts ask a device for something."""
        return self._topic("DCMD", device)

    @property
    def is_born(self) -> bool:
        """Whether data may be sent."""
        return None in self._born

    def lives(self, device: str) -> bool:
        """Whether data of a device may be sent."""
        return device in self._born

    def will(self, bd_seq: int, sent_ms: int) -> Publication:
        """The death certificate of the session to come: the last will, and what is sent before leaving.

        Args:
            bd_seq: number of the session, 0 to 255.
            sent_ms: now, UTC, ms since 1970.
        """
        payload = Payload(sent_ms, None, (_bd_seq(bd_seq, sent_ms),))
        return Publication(self._topic("NDEATH", None), encode(payload), qos=1)

    def births(
        self, bd_seq: int, sent_ms: int, node: Sequence[Metric], devices: Mapping[str, Sequence[Metric]]
    ) -> list[Publication]:
        """Births of the node and its devices; data may follow.

        Args:
            bd_seq: that of the session's last will.
            sent_ms: now, UTC, ms since 1970.
            node: all metrics of the node, by name, with datatype and present value.
            devices: the same of every device that is there.
        """
        self._seq = 0
        control = Metric(name=REBIRTH, timestamp_ms=sent_ms, datatype=DataType.BOOLEAN, value=False)
        named = [self._named(None, metric) for metric in node]
        self._born = {None: frozenset(metric.name or "" for metric in node)}
        first = self._message("NBIRTH", None, sent_ms, [_bd_seq(bd_seq, sent_ms), control, *named], True)
        return [first, *(self.device_birth(name, sent_ms, metrics) for name, metrics in devices.items())]

    def device_birth(self, device: str, sent_ms: int, metrics: Sequence[Metric]) -> Publication:
        """Birth of a device: it has come, or has got new metrics.

        Raises:
            OrderError: the node is not born.
        """
        _check("device", device)
        self._demand(None)
        named = [self._named(device, metric) for metric in metrics]
        self._born[device] = frozenset(metric.name or "" for metric in metrics)
        return self._message("DBIRTH", device, sent_ms, named, True)

    def device_death(self, device: str, sent_ms: int) -> Publication:
        """Death of a device: nothing is known of it until it is born again.

        Raises:
            OrderError: it is not born.
        """
        self._demand(device)
        del self._born[device]
        return self._message("DDEATH", device, sent_ms, [], False)

    def data(self, device: str | None, sent_ms: int, metrics: Sequence[Metric]) -> Publication:
        """Values that have changed.

        Args:
            device: whose; None for the node's own.
            sent_ms: now, UTC, ms since 1970.
            metrics: by name.

        Raises:
            OrderError: the node or device is not born, or its birth did not name one of the metrics.
        """
        self._demand(device)
        unknown = [metric.name for metric in metrics if metric.name not in self._born[device]]
        if unknown:
            raise OrderError(f"no birth of {device or self._name} names {', '.join(map(repr, unknown))}")
        kind = "NDATA" if device is None else "DDATA"
        return self._message(kind, device, sent_ms, [self._aliased(device, m) for m in metrics], False)

    def knows(self, device: str | None, metrics: Iterable[Metric]) -> bool:
        """Whether `data` may carry these metrics."""
        return device in self._born and all(metric.name in self._born[device] for metric in metrics)

    def die(self) -> None:
        """The session is over: births come before anything else."""
        self._born = {}

    def command(self, device: str | None, payload: bytes) -> Payload:
        """What a host has written to metrics of a device, or of the node, each by its name.

        Raises:
            PayloadError: it is no payload, or an alias represents no metric.
        """
        metrics = decode(payload)
        return replace(metrics, metrics=tuple(self._by_name(device, metric) for metric in metrics.metrics))

    def wants_rebirth(self, asked: Sequence[Metric]) -> bool:
        """Whether metrics of the node that a host has written ask for new births.

        Raises:
            PayloadError: they ask for something else.
        """
        if not asked:
            raise PayloadError("a command without a metric asks for nothing")
        for metric in asked:
            if metric.name != REBIRTH or not isinstance(metric.value, bool):
                raise PayloadError(f"metric {metric.name!r} cannot be written; only {REBIRTH} = true")
        return any(metric.value for metric in asked)

    def _message(
        self,
        kind: str,
        device: str | None,
        sent_ms: int,
        metrics: Sequence[Metric],
        birth: bool,  # noqa: FBT001 - a birth writes names and datatypes, data do without
    ) -> Publication:
        payload = Payload(sent_ms, self._seq, tuple(metrics))
        publication = Publication(self._topic(kind, device), encode(payload, datatypes=birth))
        self._seq = (self._seq + 1) % NUMBERS
        return publication

    def _named(self, device: str | None, metric: Metric) -> Metric:
        """A metric as a birth has it: with name and alias."""
        if metric.name is None or metric.name in {BDSEQ, REBIRTH}:
            raise OrderError(f"a metric cannot be named {metric.name!r}")
        alias = self._aliases.setdefault((device, metric.name), len(self._aliases) + 1)
        self._names[alias] = device, metric.name
        return replace(metric, alias=alias)

    def _aliased(self, device: str | None, metric: Metric) -> Metric:
        """A metric as data have it: the alias alone."""
        return replace(metric, name=None, alias=self._aliases[device, metric.name or ""], properties={})

    def _by_name(self, device: str | None, metric: Metric) -> Metric:
        """A metric as a host has written it, with the name that its alias represents."""
        if metric.name is not None or metric.alias is None:
            return metric
        owner, name = self._names.get(metric.alias, (None, None))
        if name is not None and owner == device:
            return replace(metric, name=name)
        raise PayloadError(f"alias {metric.alias} is the alias of no metric of {device or self._name}")

    def _demand(self, owner: str | None) -> None:
        if owner not in self._born:
            raise OrderError(f"{owner or self._name} is not born; publish its birth first")

    def _topic(self, kind: str, device: str | None) -> str:
        topic = f"{NAMESPACE}/{self._group}/{kind}/{self._name}"
        return topic if device is None else f"{topic}/{device}"


def _bd_seq(number: int, sent_ms: int) -> Metric:
    return Metric(name=BDSEQ, timestamp_ms=sent_ms, datatype=DataType.INT64, value=number)


def _check(what: str, name: str) -> None:
    if not name or _FORBIDDEN.search(name):
        raise ValueError(
            f"{name!r} cannot be a Sparkplug {what} id: it is part of a topic; leave out '+', '/' and '#'"
        )
