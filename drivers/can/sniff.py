"""``daqsvc sniff can``: which ids come over a CAN bus, how often, and the values by a DBC file."""

from __future__ import annotations

import errno
import json
import logging
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from daqsvc.documentation import documented_in
from daqsvc.rounding import counted
from drivers.can.numbered import (
    Level,
    is_named_sample,
    levels_apart,
    most_likely_samples,
    numbered,
    of_one_channel,
    of_separate_sensors,
    samples_of_one,
)
from drivers.can.other_source import other_sources
from drivers.names import CAN, bus_name, message_stream, unused
from drivers.sniffing import (
    Sniffed,
    Sniffer,
    SniffError,
    SniffTable,
    Values,
    quoted,
    rounded_rate,
    sensor_lines,
)

if TYPE_CHECKING:
    import argparse
    import threading
    from collections.abc import Callable, Iterator, Sequence

    from drivers.can.batches import CanSource
    from drivers.can.dbc_traffic import DbcTraffic, MessageTraffic, SignalTraffic
    from drivers.can.settings import CanBus
    from drivers.can.sniff_json import CanFigures, CanIdFigures, DbcFigures
    from drivers.can.traffic import IdTraffic, Traffic

SECONDS = 5.0
LONGEST_SECONDS = 3600.0
LONGER_S = 20.0
"""For which it goes on by itself where frames come, and too few to judge their rates."""
_FEW = 3
TYPICAL_BITRATE = 500_000
_POLL_S = 0.1
_EXACT = "the device's manual has the exact one"
_SHOWN_BYTES = 16
_NETWORK = Path("/sys/class/net")
_ARPHRD_CAN = 280
"""``/sys/class/net/NAME/type`` of a CAN interface (linux/if_arp.h)."""
_IP_S = 2.0


class CanSniffer(Sniffer):
    """See `drivers.sniffing.Sniffer`.

    Args:
        seconds: time to listen, unless it is stated by ``--seconds``.
    """

    help = "listen to a CAN bus: ids, rates, bytes that change, values with a DBC file"
    description = (
        "Listen to a CAN or CAN FD bus. Print each id, how often and how evenly it comes, how long its "
        "frames are and which bytes change. With a DBC file also print the values of its signals. "
        "Nothing is sent."
    )

    def __init__(self, seconds: float = SECONDS) -> None:
        self._seconds = seconds

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `drivers.sniffing.Sniffer.add_arguments`."""
        parser.add_argument("channel", metavar="INTERFACE", help="CAN interface, e.g. can0")
        parser.add_argument("--dbc", type=Path, metavar="FILE", help="DBC file of the messages and signals")
        parser.add_argument(
            "--seconds",
            type=float,
            metavar="S",
            help=f"time to listen, in s (default: {SECONDS:g}, and up to {LONGER_S:g} more if few frames "
            "come)",
        )
        parser.add_argument(
            "--fd",
            action="store_true",
            help="also receive CAN FD frames; interfaces of the kernel and those between programs always do",
        )
        parser.add_argument(
            "--bitrate",
            type=int,
            metavar="BIT/S",
            help="bit rate of the bus, from which its load is computed (default: ask the kernel)",
        )
        parser.add_argument(
            "--data-bitrate",
            type=int,
            metavar="BIT/S",
            help="bit rate of the data of CAN FD frames (default: ask the kernel)",
        )
        parser.add_argument(
            "--interface",
            default="socketcan",
            metavar="NAME",
            help="interface as python-can names it, e.g. pcan (default: socketcan, those of the kernel)",
        )

    def sniff(
        self, arguments: argparse.Namespace, stop: threading.Event, tell: Callable[[str], None]
    ) -> Sniffed:
        """See `drivers.sniffing.Sniffer.sniff`."""
        from daqsvc.acquisition.clock import SystemClock  # noqa: PLC0415 - only for who listens
        from drivers.can.traffic import Traffic  # noqa: PLC0415

        facts = _kernel_facts(arguments.channel) if arguments.interface == "socketcan" else _NO_FACTS
        bus = _bus(arguments, facts)
        seconds = self._seconds if arguments.seconds is None else arguments.seconds
        if not 0 < seconds <= LONGEST_SECONDS:
            raise SniffError(
                f"--seconds {seconds:g}: give a time above 0, up to {LONGEST_SECONDS:g} s",
                usage=True,
            )
        dbc = None if arguments.dbc is None else _dbc(arguments.dbc)
        source = _opened(bus, SystemClock())
        traffic = Traffic()
        tell(f"listening to {bus.channel} for {seconds:g} s; Ctrl-C ends it early")
        begin_s = time.monotonic()
        try:
            lost = _listen(source, traffic, dbc, stop, begin_s + seconds)
            if arguments.seconds is None and not lost and not stop.is_set() and _are_few(traffic):
                tell(
                    f"too few frames came in {seconds:g} s to judge their rates: listening for up to "
                    f"{LONGER_S:g} s more; --seconds sets the time"
                )
                until_s = time.monotonic() + LONGER_S
                lost = _listen(source, traffic, dbc, stop, until_s, until=lambda: not _are_few(traffic))
        finally:
            source.close()
        return _Report(bus, traffic, dbc, arguments.dbc, time.monotonic() - begin_s, lost).sniffed()


class _KernelFacts(NamedTuple):
    """What the kernel states of an interface: its bit rates, where it is a real one."""

    bitrate: int | None = None
    data_bitrate: int | None = None


_NO_FACTS = _KernelFacts()


def _kernel_facts(channel: str) -> _KernelFacts:
    """Bit rates of an interface, as ``ip`` shows them; none where there is no ``ip``, or no bit rate."""
    command = ["ip", "-json", "-details", "link", "show", "dev", channel]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_IP_S, check=True)  # noqa: S603
        shown = json.loads(done.stdout)[0]["linkinfo"]["info_data"]
        return _KernelFacts(
            (shown.get("bittiming") or {}).get("bitrate"), (shown.get("data_bittiming") or {}).get("bitrate")
        )
    except (OSError, subprocess.SubprocessError, ValueError, LookupError, TypeError, AttributeError):
        return _NO_FACTS


def _bus(arguments: argparse.Namespace, facts: _KernelFacts) -> CanBus:
    """The table that a machine file would have for the bus.

    Raises:
        SniffError: an argument is no value that it could have.
    """
    from pydantic import ValidationError  # noqa: PLC0415 - only for who listens

    from drivers.can.settings import CanBus  # noqa: PLC0415

    data_bitrate = arguments.data_bitrate or facts.data_bitrate
    table = {
        "driver": "can",
        "interface": arguments.interface,
        "channel": arguments.channel,
        "fd": arguments.fd or arguments.data_bitrate is not None,
        "bitrate": arguments.bitrate or facts.bitrate,
        "data_bitrate": data_bitrate,
        "filter": False if arguments.interface == "socketcan" else None,
    }
    try:
        return CanBus.model_validate({key: value for key, value in table.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        key = {"channel": "INTERFACE"}.get(f"{first['loc'][0]}", f"--{first['loc'][0]}".replace("_", "-"))
        raise SniffError(f"{key} {first['input']!r}: {first['msg']}", usage=True) from error


def _dbc(file: Path) -> DbcTraffic:
    from drivers.can.dbc import messages_of  # noqa: PLC0415 - only for who listens
    from drivers.can.dbc_traffic import DbcTraffic  # noqa: PLC0415
    from drivers.fields import LayoutError  # noqa: PLC0415

    if not file.exists():
        raise SniffError(f"--dbc: there is no file {file}; correct the path", usage=True)
    try:
        return DbcTraffic(messages_of(file))
    except LayoutError as error:
        raise SniffError(f"--dbc: {error}", usage=True) from error


_BETWEEN_PROGRAMS = frozenset({"unixbus", "virtual"})
"""Interfaces without hardware, which carry both kinds of frames."""


def _opened(bus: CanBus, clock: Any) -> CanSource:
    """The open bus.

    Raises:
        SniffError: it cannot be opened; states what to do.
    """
    if bus.interface == "socketcan":
        from drivers.can.batches import IdMatch  # noqa: PLC0415 - only for who listens
        from drivers.can.socketcan import open_socketcan  # noqa: PLC0415

        try:
            return open_socketcan(bus, [IdMatch(0, 0)], clock, recorded=True)
        except OSError as error:
            raise SniffError(_why_not_open(error, bus.channel)) from error
    from can.interfaces import BACKENDS  # noqa: PLC0415 - slow to import

    from daqsvc.settings.problems import choice  # noqa: PLC0415
    from drivers.can.adapter import open_adapter  # noqa: PLC0415

    if bus.interface not in BACKENDS:
        remedy = f"{choice(bus.interface, BACKENDS)}; or install the python-can plugin that brings it"
        raise SniffError(
            f"--interface {bus.interface}: python-can knows no such interface. Remedy: {remedy}", usage=True
        )
    # python-can logs which optional parts are missing, beside the error that states what is wrong.
    logging.getLogger("can").addHandler(logging.NullHandler())
    # Between programs FD frames cost nothing; whether they are there is what somebody wants to know.
    opened = bus.model_copy(update={"fd": True}) if bus.interface in _BETWEEN_PROGRAMS else bus
    try:
        return open_adapter(opened, clock)
    except Exception as error:
        reason = f"{error}" or type(error).__name__
        raise SniffError(
            f"{bus.interface} {bus.channel} cannot be opened: {reason}. Remedy: see what is plugged in and "
            "whether its driver is installed"
        ) from error


def _why_not_open(error: OSError, channel: str) -> str:
    if "/" in channel:
        remedy = "for the path of a bus between programs write --interface unixbus"
        return f"{channel} is no CAN interface of the kernel. Remedy: {remedy}"
    if error.errno == errno.ENODEV:
        there = can_interfaces()
        listed = (
            f"CAN interfaces of this computer: {', '.join(there)}" if there else "it has no CAN interface"
        )
        return (
            f"there is no CAN interface {channel} ({listed}). Remedy: plug the adapter in and see `dmesg`, "
            f"or correct the name; for a virtual bus: ip link add dev {channel} type vcan"
        )
    if error.errno == errno.ENETDOWN:
        return f"{channel} is down. Remedy: {_set_up(channel)}"
    return f"{channel} cannot be opened: {error.strerror or error}"


def can_interfaces() -> list[str]:
    """CAN interfaces of this computer."""

    def is_can(interface: Path) -> bool:
        try:
            return int((interface / "type").read_text()) == _ARPHRD_CAN
        except (OSError, ValueError):
            return False

    try:
        return sorted(path.name for path in _NETWORK.iterdir() if is_can(path))
    except OSError:
        return []


def _set_up(channel: str, bitrate: int | None = None) -> str:
    """The command that sets an interface up."""
    if channel.startswith("vcan"):
        return f"ip link set {channel} up"
    return f"ip link set {channel} up type can bitrate {bitrate or TYPICAL_BITRATE}"


def _listen(
    source: CanSource,
    traffic: Traffic,
    dbc: DbcTraffic | None,
    stop: threading.Event,
    until_s: float,
    until: Callable[[], bool] = lambda: False,
) -> str:
    """Take in frames until it is time, or the bus is lost; returns why it was lost, else nothing."""
    from drivers.can.batches import BusOffError  # noqa: PLC0415 - only for who listens
    from drivers.can.errors import BUS_OFF_REASON  # noqa: PLC0415
    from drivers.reconnect import words  # noqa: PLC0415

    while not stop.is_set() and not until() and (left_s := until_s - time.monotonic()) > 0:
        try:
            batch = source.read(min(left_s, _POLL_S))
        except BusOffError:
            return BUS_OFF_REASON
        except Exception as error:  # noqa: BLE001 - adapters raise what they like
            return words(error)
        traffic.take(batch, source.error_classes)
        if dbc is not None:
            dbc.take(batch)
        if len(batch.ids):
            source.gather(stop)
    return ""


def _are_few(traffic: Traffic) -> bool:
    """Whether frames came, and none often enough to show its rate."""
    return bool(traffic.ids) and all(one.frames < _FEW for one in traffic.ids.values())


class _Report(NamedTuple):
    """What was heard, in words, in figures and as a machine file."""

    bus: CanBus
    traffic: Traffic
    dbc: DbcTraffic | None
    dbc_file: Path | None
    seconds: float
    lost: str

    def sniffed(self) -> Sniffed:
        """All of it."""
        heard = bool(self.traffic.ids)
        return Sniffed(
            list(self._parts()), self._figures(), self._fragment() if heard else "", self._problem()
        )

    @property
    def _fd(self) -> bool:
        return self.bus.fd or self.traffic.fd

    @property
    def _ids(self) -> list[IdTraffic]:
        """By how urgent they are on the bus."""
        return sorted(
            self.traffic.ids.values(), key=lambda one: (one.extended, one.arbitration_id, one.remote)
        )

    @property
    def _load(self) -> tuple[float, float] | None:
        if self.bus.bitrate is None:
            return None
        return self.traffic.load(self.seconds, self.bus.bitrate, self.bus.data_bitrate)

    def _problem(self) -> str:
        name = self.bus.channel
        of_kernel = self.bus.interface == "socketcan"
        if self.lost:
            remedy = _set_up(name) if of_kernel else "check whether it is still plugged in, or still runs"
            return f"{name} was lost after {self.seconds:.1f} s: {self.lost}. Remedy: {remedy}"
        if self.traffic.ids:
            return ""
        if "/" in name and not of_kernel:
            return (
                f"{name}: no frame in {self.seconds:.1f} s. Remedy: start the program that sends there, and "
                "check that it has the same path"
            )
        if not of_kernel and not self.traffic.error_frames:
            return (
                f"{name}: no frame in {self.seconds:.1f} s. Remedy: check that the devices are powered and "
                "send without being asked, and that CAN_H and CAN_L are not swapped; give the bit rate with "
                "--bitrate, and --fd on a bus with CAN FD"
            )
        if self.traffic.error_frames:
            return (
                f"{name}: no frame in {self.seconds:.1f} s, but {self.traffic.error_frames} error frames: "
                "the bit rate is most likely wrong. Remedy: take the one of the devices, `ip link set "
                f"{name} down`, then `{_set_up(name, self.bus.bitrate)}`; check termination and wiring"
            )
        return (
            f"{name}: no frame in {self.seconds:.1f} s. Remedy: check that the devices are powered and send "
            "without being asked; that CAN_H and CAN_L are not swapped, with 120 ohm at both ends; and that "
            f"the bit rate is theirs (`ip link set {name} down`, then `{_set_up(name, self.bus.bitrate)}`)"
        )

    def _parts(self) -> Iterator[str | SniffTable]:
        frames, ids = self.traffic.frames, self._ids
        summary = (
            f"{self.bus.channel}: {frames} frames in {self.seconds:.1f} s, {len(ids)} {_plural('id', ids)}"
        )
        if (load := self._load) is not None and self.bus.bitrate is not None:
            from daqsvc.settings.buses import percent  # noqa: PLC0415 - only for who listens

            summary += f", load {percent(*load)} of {self.bus.bitrate:,} bit/s"
        elif frames:
            summary += "; give --bitrate to see the load of the bus"
        yield summary
        if self.traffic.dropped:
            yield f"{counted(self.traffic.dropped, 'frame')} dropped: this computer was too slow."
        if self.traffic.error_frames:
            yield self._errors()
        if ids:
            titles: tuple[str, ...] = (
                "id",
                "kind",
                "bytes",
                "frames/s",
                "period",
                "std",
                "bytes that change",
                "last payload",
            )
            titles += ("counter",) if any(one.counter for one in ids) else ()
            titles += ("message",) if self.dbc else ()
            yield SniffTable(titles, [self._id_row(one, len(titles)) for one in ids])
        if self.dbc is not None:
            yield from self._dbc_parts(self.dbc)

    def _id_row(self, one: IdTraffic, columns: int) -> list[str]:
        row = [
            _id(one.arbitration_id, extended=one.extended),
            one.kind,
            _ranges(one.lengths),
            "-" if one.rate_hz is None else f"{one.rate_hz:.4g}",
            _ms(one.period_s),
            _ms(one.period_std_s),
            _ranges(one.changed_bytes) or "none",
            _payload(one.last) or "-",
        ]
        message = None if self.dbc is None else self.dbc.message_of(one.frame_id)
        if columns - len(row) == 1 + (self.dbc is not None):
            row.append(f"{one.counter}" if one.counter else "-")
        if self.dbc is not None:
            row.append("not in the DBC file" if message is None else message.name)
        return row

    def _errors(self) -> str:
        errors = self.traffic.errors
        counts = ", ".join(f"{name} {count}" for name, count in errors.counts.items())
        state = "" if errors.state is None else f"; the controller is {errors.state}"
        return f"{counted(self.traffic.error_frames, 'error frame')}: {counts or 'of no known class'}{state}"

    def _dbc_parts(self, dbc: DbcTraffic) -> Iterator[str | SniffTable]:
        rows = [
            [
                message.name,
                signal.name,
                *_values(signal.last, signal.least, signal.most),
                signal.unit or "-",
                signal.choice or _as_counter(signal.step),
            ]
            for message in dbc.heard
            for signal in message.signals
            if signal.frames
        ]
        if rows:
            yield SniffTable(("message", "signal", "last", "min", "max", "unit", ""), rows)
        for message in dbc.heard:
            yield from (f"{message.name}: {signal.doubt}" for signal in message.signals if signal.doubt)
            if message.short:
                yield (
                    f"{message.name}: {message.short} of {message.frames} frames have fewer than the "
                    f"{message.length} bytes of the DBC file, and are left out above."
                )
            yield from (doubt for doubt in (message.length_doubt, self._rate_doubt(message)) if doubt)
            yield from (f"{message.name}: {reason}." for reason in message.unusable)
        if dbc.missing:
            named = [f"{one.name} ({_id(one.frame_id, extended=one.extended)})" for one in dbc.missing]
            yield f"In the DBC file, but not heard: {', '.join(named)}"
        strange = [one for one in self._ids if not one.remote and dbc.message_of(one.frame_id) is None]
        if strange:
            named = [_id(one.arbitration_id, extended=one.extended) for one in strange]
            yield f"Heard, but not in the DBC file: {', '.join(named)}"
            missing = {one.name: one.frame_id for one in dbc.missing if one.extended}
            extended = [one.arbitration_id for one in strange if one.extended]
            yield from (f"{words}." for words in other_sources(extended, missing))

    def _rate_doubt(self, message: MessageTraffic) -> str:
        rates = (self.traffic.ids[one].rate_hz for one in message.ids)
        return message.rate_doubt(max((rate for rate in rates if rate is not None), default=None))

    def _figures(self) -> CanFigures:
        load = self._load
        figures: CanFigures = {
            "bus": "can",
            "interface": self.bus.interface,
            "channel": self.bus.channel,
            "seconds": round(self.seconds, 3),
            "frames": self.traffic.frames,
            "frames_dropped": self.traffic.dropped,
            "error_frames": self.traffic.error_frames,
            "errors": self.traffic.errors.counts,
            "controller_state": self.traffic.errors.state,
            "bitrate": self.bus.bitrate,
            "data_bitrate": self.bus.data_bitrate,
            "load": None if load is None else {"least": load[0], "most": load[1]},
            "ids": [self._id_figures(one) for one in self._ids],
        }
        if self.dbc is not None:
            figures["dbc"] = self._dbc_figures(self.dbc)
        return figures

    def _id_figures(self, one: IdTraffic) -> CanIdFigures:
        message = None if self.dbc is None else self.dbc.message_of(one.frame_id)
        return {
            "id": one.arbitration_id,
            "extended": one.extended,
            "remote": one.remote,
            "fd": any(wire.fd for wire in one.wires),
            "bit_rate_switch": any(wire.switches for wire in one.wires),
            "frames": one.frames,
            "lengths": one.lengths,
            "rate_hz": one.rate_hz,
            "period_s": one.period_s,
            "period_std_s": one.period_std_s,
            "period_min_s": None if one.frames < 2 else one.shortest_s,
            "period_max_s": None if one.frames < 2 else one.longest_s,
            "changed_bytes": one.changed_bytes,
            "last": one.last.hex(),
            "counter": None if one.counter is None else one.counter._asdict(),
            "message": None if message is None else message.name,
        }

    def _dbc_figures(self, dbc: DbcTraffic) -> DbcFigures:
        return {
            "messages": [
                {
                    "message": message.name,
                    "id": message.frame_id,
                    "frames": message.frames,
                    "frames_short": message.short,
                    "frames_long": message.long,
                    "length_doubt": message.length_doubt,
                    "rate_doubt": self._rate_doubt(message),
                    "signals": [
                        {
                            "signal": signal.name,
                            "unit": signal.unit,
                            "frames": signal.frames,
                            "last": signal.last,
                            "min": signal.least,
                            "max": signal.most,
                            "mean": signal.mean,
                            "deviation": signal.deviation,
                            "dbc_min": signal.stated[0],
                            "dbc_max": signal.stated[1],
                            "doubt": signal.doubt,
                            "counts_frames": signal.counts,
                            "rises": signal.rises,
                            "step": signal.step,
                            "multiplexed": signal.multiplexed,
                        }
                        for signal in message.signals
                        if signal.frames
                    ],
                }
                for message in dbc.heard
            ],
            "not_heard": [message.name for message in dbc.missing],
        }

    def _fragment(self) -> str:
        name = bus_name(self.bus.channel, CAN)
        lines = [
            f"[buses.{name}]",
            'driver = "can"',
            f"interface = {quoted(self.bus.interface)}",
            f"channel = {quoted(self.bus.channel)}",
        ]
        lines += ["fd = true"] * self._fd
        if self.bus.bitrate is not None:
            lines.append(f"bitrate = {self.bus.bitrate:_}")
        if self._fd and self.bus.data_bitrate is not None:
            lines.append(f"data_bitrate = {self.bus.data_bitrate:_}")
        taken: set[str] = set()
        sensors: set[str] = set()
        for message in self.dbc.heard if self.dbc is not None else ():
            lines += ["", *self._stream(message, name, taken, sensors)]
        unknown = [
            one
            for one in self._ids
            if not one.remote and (self.dbc is None or self.dbc.message_of(one.frame_id) is None)
        ]
        if unknown:
            lines += [
                "",
                "# Where samples lie in these frames is in the manuals of the devices, or in a DBC file:",
            ]
            lines += [f"#   {_in_words(one)}" for one in unknown]
        return "\n".join(lines)

    def _stream(self, message: MessageTraffic, bus: str, taken: set[str], sensors: set[str]) -> Sequence[str]:
        """A stream of a message, as far as one can be made of what is known."""
        of_ids = [one for key in sorted(message.ids) if (one := self.traffic.ids[key]).rate_hz is not None]
        measured = [s for s in message.signals if s.frames and not s.counts and not s.multiplexed]
        channels = [s for s in measured if not s.named and not s.rises and s.step is None]
        if any(signal.multiplexed for signal in message.signals):
            return [
                f"# {message.name} is multiplexed: make a stream for each page; daqsvc new makes that of one"
            ]
        if message.length_doubt:
            return [f"# {message.length_doubt}"]
        if len(of_ids) != 1 or not channels or message.short:
            return [f"# {message.name} came too seldom, or not as the DBC file describes it"]
        rate_hz = of_ids[0].rate_hz
        assert rate_hz is not None and self.dbc_file is not None  # noqa: S101, PT018 - for the type checker
        name = unused(message_stream(message.name), taken)
        counter = message.counter
        samples, is_guess = _likely_samples(message, channels)
        if counter is None and (counter := _counter_of_samples(message)) is not None:
            together = numbered([s.name for s in channels]).items()
            samples = {stem: names for stem, names in together if len(names) == counter.step}
            is_guess = False
        read = [s for s in channels if any(s.name in names for names in samples.values())]
        first = {name: next(s for s in channels if s.name == names[0]) for name, names in samples.items()}
        in_frame = len(next(iter(samples.values())))
        assumed = "    # assumed" * is_guess
        return [
            f"[streams.{name}]",
            f"bus = {quoted(bus)}",
            *([f"# {doubt}"] if (doubt := self._rate_doubt(message)) else []),
            f"rate_hz = {rounded_rate(rate_hz * in_frame)}    # as measured; {_EXACT}",
            "",
            f"[streams.{name}.layout]",
            f"dbc = {quoted(f'{self.dbc_file.absolute()}')}",
            f"message = {quoted(message.name)}",
            "no_counter = true    # none was seen"
            if counter is None
            else f"counter = {{ signal = {quoted(counter.name)}, "
            f'counts = "{"frames" if counter.counts else "samples"}" }}',
            "channels = [",
            *(
                f"  {{ name = {quoted(one)}, signals = {_array(names)} }},{assumed}"
                for one, names in samples.items()
            ),
            "]",
            *(of_separate_sensors(samples) if is_guess else ()),
            *(
                f"# {s.name} is left out: {_why_left_out(s)}"
                for s in measured
                if s not in channels and s is not counter
            ),
            *(f"# {s.name} is left out: it {of_another_stream(in_frame)}" for s in channels if s not in read),
            *(f"# {s.doubt}" for s in read if s.doubt),
            *(of_one_channel([s.name for s in channels]) if in_frame == 1 else ()),
            *sensor_lines(
                name,
                {one: s.unit for one, s in first.items() if s.unit} or dict.fromkeys(first, "1"),
                sensors,
                rate_hz * in_frame,
                values={one: Values(s.unsigned, s.least, s.most) for one, s in first.items()},
            ),
        ]


def _likely_samples(
    message: MessageTraffic, channels: Sequence[SignalTraffic]
) -> tuple[dict[str, list[str]], bool]:
    """Signals of each channel as ``daqsvc new`` takes them, and whether that is a guess."""
    names = [one.name for one in channels]
    levels = {one.name: Level(one.frames, one.mean, one.deviation, one.resolution) for one in channels}
    samples = samples_of_one(most_likely_samples(channels, names))
    if not samples or levels_apart(message.signals, names, levels):
        return {name: [name] for name in names}, False
    return samples, not all(is_named_sample(stem) for stem in samples)


def _counter_of_samples(message: MessageTraffic) -> SignalTraffic | None:
    """A signal that counts the samples: it grows by as many as there are numbered signals of one channel."""
    many = {len(names) for names in numbered([one.name for one in message.signals if one.frames]).values()}
    candidates = (one for one in message.signals if not one.multiplexed and one.step in many)
    return next(candidates, None)


def _as_counter(step: int | None) -> str:
    if step is None:
        return ""
    return "counts frames" if step == 1 else f"grows by {step:,} with each frame"


def _array(names: Sequence[str]) -> str:
    return f"[{', '.join(map(quoted, names))}]"


def of_another_stream(samples: int) -> str:
    """Why a signal is not read beside several samples of other channels."""
    return f"comes once a frame, the channels have {samples} samples in it; another stream reads it"


def _why_left_out(signal: SignalTraffic) -> str:
    return STATE if signal.named else CLOCK


CLOCK = "it rises all the time, as a clock does"
STATE = f'its values have names, as states have: see "A state or an enum signal" of {documented_in("alarms")}'
"""Why a signal is no measured value, and where what to do with it is described."""


def _id(frame_id: int, *, extended: bool) -> str:
    return f"0x{frame_id:08X}" if extended else f"0x{frame_id:03X}"


def _in_words(one: IdTraffic) -> str:
    counter = f", counter at {one.counter}" if one.counter else ""
    rate = "once" if one.rate_hz is None else f"{rounded_rate(one.rate_hz):g}/s"
    changing = _ranges(one.changed_bytes)
    return (
        f"{_id(one.arbitration_id, extended=one.extended)}: {_ranges(one.lengths)} bytes, {rate}, "
        f"{f'bytes {changing} change' if changing else 'always the same'}{counter}"
    )


def _ranges(numbers: Sequence[int]) -> str:
    """Numbers in order, those in a row as a range: ``0-3, 7``."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(f"{low}" if low == high else f"{low}-{high}" for low, high in runs)


def _plural(word: str, things: Sequence[object]) -> str:
    return word if len(things) == 1 else f"{word}s"


def _ms(time_s: float | None) -> str:
    return "-" if time_s is None else f"{1e3 * time_s:.4g} ms"


def _payload(data: bytes) -> str:
    return data[:_SHOWN_BYTES].hex(" ") + (" ..." if len(data) > _SHOWN_BYTES else "")


def _values(*values: float) -> list[str]:
    return [f"{value:.6g}" for value in values]
