"""The serial driver on pseudo-terminals: from the machine file to blocks, and a port that others want too."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import logging
import os
import termios
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.bus_tables import line_layout, serial_bus
from support.clocks import QuickClock
from support.machine_files import MACHINES
from support.waiting import PATIENCE_S, eventually

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.notice import NOTICE
from daqsvc.settings import parse_machine_file
from drivers.base import BusPort, StreamSpec
from drivers.frames import FrameLayout
from drivers.make import bus_drivers, stream_layout
from drivers.serial import driver as serial_driver
from drivers.serial import reader as serial_reader
from drivers.serial.driver import RECENT_NS, SerialDriver, framing_of
from sim_hw.link_faults import LinkFaults
from sim_hw.nodes.pacing import DrivenPacer
from sim_hw.nodes.serial_node import PseudoTerminal, SerialNode

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from daqsvc.acquisition.samples import SampleBlock
    from drivers.frames import DecodedBatch

pytestmark = pytest.mark.integration
PROBES = "/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_FT1AB2C3-if00-port0"
CASING = "/dev/serial/by-id/usb-Raspberry_Pi_Pico_E66118604B826C2A-if00"
LINE = line_layout(("seq", "x"), ("x",), counter="seq")


def lines_driver(path: Path, blocks: list[SampleBlock], **options: Any) -> SerialDriver:
    given = {"port": str(path), "framing": "lines", **options}
    spec = StreamSpec("x", LINE, 100.0)
    return SerialDriver(serial_bus(**given), BusPort("ser0", [spec], QuickClock(), blocks.append))


@contextlib.asynccontextmanager
async def running(*drivers: SerialDriver) -> AsyncIterator[None]:
    tasks = [asyncio.create_task(driver.run()) for driver in drivers]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@pytest.mark.long
async def test_two_ports_of_a_machine_file_end_in_exact_books(tmp_path: Path) -> None:
    text = (MACHINES / "serial-probes.toml").read_text()
    text = text.replace(PROBES, str(tmp_path / "probes")).replace(CASING, str(tmp_path / "casing"))
    machine = parse_machine_file(text, tmp_path / "machine.toml")
    clock = DrivenClock()
    blocks: dict[str, list[SampleBlock]] = {"shaft": [], "casing": []}
    drivers = bus_drivers(machine, clock, lambda block: blocks[block.stream].append(block))
    faults = LinkFaults(drop=0.02, duplicate=0.02, corrupt=0.02, reorder=0.02, seed=5)
    rng = np.random.default_rng(3)
    nodes: dict[str, SerialNode] = {}
    sent: dict[str, Any] = {}
    with PseudoTerminal(tmp_path / "probes") as probes, PseudoTerminal(tmp_path / "casing") as casing:
        for stream, bus, cable, seconds in (("shaft", "probes", probes, 2), ("casing", "casing", casing, 2)):
            layout = stream_layout(machine, stream)
            rate_hz = machine.streams[stream].rate_hz
            framing = framing_of(machine.buses[bus], [StreamSpec(stream, layout, rate_hz)])
            sent[stream] = rng.normal(0, 5, (int(seconds * rate_hz), len(layout.channels)))
            nodes[stream] = SerialNode(cable, framing, stream, layout, sent[stream], rate_hz, faults=faults)
        async with running(*drivers):
            await eventually(
                lambda: all(driver.link.state == "up" for driver in drivers), "both ports are open"
            )

            def behind() -> int:
                done = [node.injected for node in nodes.values()]
                seen = sum(c.frames_received for driver in drivers for c, _ in driver.streams.values())
                return sum(d.frames_in - d.lost for d in done) - seen

            pacer = DrivenPacer(clock, behind, 64)
            await asyncio.gather(*(node.play(pacer) for node in nodes.values()))
            await eventually(lambda: behind() <= 0, "all frames are in")
    for driver in drivers:
        for stream, (counters, _) in driver.streams.items():
            done = nodes[stream].injected
            assert min(done.dropped, done.duplicated, done.corrupted, done.reordered) > 0
            assert counters.samples_received + counters.samples_lost == nodes[stream].samples_sent
            assert counters.samples_lost == done.lost * nodes[stream]._per_frame
            assert counters.frames_duplicate == done.duplicated
            for block in blocks[stream]:
                took = sent[stream][block.first_index : block.end_index]
                np.testing.assert_allclose(block.samples, took, atol=0.1 if stream == "shaft" else 1e-5)
            assert nodes[stream].frames_unsent == 0


async def test_a_port_that_another_program_has_is_waited_for(tmp_path: Path) -> None:
    with PseudoTerminal(tmp_path / "port") as cable:
        other = os.open(cable.path, os.O_RDWR | os.O_NOCTTY)
        fcntl.flock(other, fcntl.LOCK_EX)
        first, second = (lines_driver(cable.path, []) for _ in range(2))
        async with running(first):
            await eventually(
                lambda: "another program has it open" in first.link.reason, "the port is refused"
            )
            os.close(other)
            await eventually(lambda: first.link.state == "up", "the port is free")
            async with running(second):
                await eventually(lambda: second.counters.open_failures > 1, "a second reader is refused")
                assert first.link.state == "up"
            assert "stop that program" in second.link.reason


@pytest.mark.gives("B34")
async def test_what_is_wrong_is_said_once_with_its_remedy(tmp_path: Path, caplog: Any) -> None:
    blocks: list[SampleBlock] = []
    driver = lines_driver(tmp_path / "port", blocks)
    with caplog.at_level(logging.INFO):
        async with running(driver):
            await eventually(lambda: driver.counters.open_failures > 2, "there is no port")
            with PseudoTerminal(tmp_path / "port") as cable:
                await eventually(lambda: driver.link.state == "up", "the port is there")
                os.write(cable.fd, b"half a line\n1,1\n#\n2,2\nwhat?\n3,3\n")
                await eventually(lambda: driver.counters.frames_malformed == 2, "all is read")
            await eventually(lambda: driver.link.state == "down", "the plug is pulled")
    said = [record.message for record in caplog.records if record.levelno >= NOTICE]
    assert len(said) == 4
    assert f"there is no {tmp_path / 'port'}; plug the device in, or correct port" in said[0]
    assert said[1].endswith("is there now")
    assert 'left out; the first line is "#": 1 column, the file lists 2 (seq, x). If it is all' in said[2]
    assert "If it is all of them, remove the 1 column that the device does not send from line" in said[2]
    assert "unplugged" in said[3]
    assert [block.samples[:, 0].tolist() for block in blocks] == [[1.0, 2.0, 3.0]] or len(blocks) > 1
    assert driver.counters.bytes_garbage == 12 + 2 + 6
    assert driver.counters.bytes_received == 32
    assert driver.counters.resyncs == 2


async def test_bytes_without_any_frame_of_a_sync_word_are_logged_once_and_stated_of_the_stream(
    tmp_path: Path, caplog: Any
) -> None:
    layout = FrameLayout.plain(
        frame_id=0,
        length=4,
        channels=[("x", 8, "unsigned", 1.0, 0.0)],
        samples_per_frame=3,
        counter_byte=0,
        counter_bits=8,
        first_byte=1,
    )
    given = {"port": str(tmp_path / "port"), "framing": "sync", "sync_word": "a55a", "crc": "none"}
    spec = StreamSpec("x", layout, 100.0)
    driver = SerialDriver(serial_bus(**given), BusPort("ser0", [spec], QuickClock(), lambda _: None))
    with caplog.at_level(logging.INFO), PseudoTerminal(tmp_path / "port") as cable:
        async with running(driver):
            await eventually(lambda: driver.link.state == "up", "the port is there")
            for number in range(1, 4):
                os.write(cable.fd, b"\x11\x22\x33\x44" * 20)
                least = 60 * number
                await eventually(lambda: driver.counters.bytes_garbage > least, "all is read")  # noqa: B023
            stated = driver.link.faults["x"]
    [said] = [record.message for record in caplog.records if "are no frame" in record.message]
    assert "left out; the sync word a55a is not in " in said
    assert "bytes: 11 22 33 44 11 22 " in said
    assert "compare baud, parity and sync_word with the device's" in said
    assert "bytes come on ser0, but no frame as its layout states; the sync word a55a is not in" in stated


async def test_errors_of_the_uart_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looks = iter([(1, 2, 3, 4), (2, 4, 3, 2**31 + 4), (2, 9, 3, -(2**31) + 5)])
    last = (2, 9, 3, -(2**31) + 5)
    monkeypatch.setattr(serial_reader, "line_errors", lambda _: serial_reader.LineErrors(*next(looks, last)))
    monkeypatch.setattr(serial_reader, "LINE_ERRORS_EVERY_NS", 0)
    driver = lines_driver(tmp_path / "port", [])
    with PseudoTerminal(tmp_path / "port"):
        async with running(driver):
            await eventually(lambda: driver.counters.overruns == 7, "the errors are counted")
    counters = driver.counters
    assert (counters.framing_errors, counters.parity_errors, counters.breaks) == (1, 0, 2**31 + 1)


async def test_the_settings_reach_the_port(tmp_path: Path) -> None:
    options = {"baud": 250_000, "stop_bits": 2, "flow_control": "xon-xoff", "low_latency": True}
    driver = lines_driver(tmp_path / "port", [], **options)
    with PseudoTerminal(tmp_path / "port") as cable:
        async with running(driver):
            await eventually(lambda: driver.link.state == "up", "the port is open")
            spare = os.open(cable.path, os.O_RDWR | os.O_NOCTTY)
            try:
                flags, _, control, local, _, speed, _ = termios.tcgetattr(spare)
            finally:
                os.close(spare)
    assert control & termios.CSTOPB
    assert flags & termios.IXON
    assert not local & termios.ICANON
    assert speed not in {termios.B115200, termios.B9600}


async def test_a_port_that_takes_its_time_to_close_does_not_hold_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    released = threading.Event()
    close = serial_reader.close_port

    def slow(device: Any) -> None:
        assert released.wait(PATIENCE_S)
        close(device)

    monkeypatch.setattr(serial_reader, "close_port", slow)
    driver = lines_driver(tmp_path / "port", [])
    with PseudoTerminal(tmp_path / "port") as cable:
        task = asyncio.create_task(driver.run())
        await eventually(lambda: driver.link.state == "up", "the port is open")
        cable.unplug()
        turns = 0
        for _ in range(50):
            await asyncio.sleep(0.001)
            turns += 1
        released.set()
        assert turns == 50
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def test_a_framing_that_fails_costs_the_link_and_not_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    driver = lines_driver(tmp_path / "port", [])

    def fail(data: bytes, arrivals_of: Any) -> None:
        raise ZeroDivisionError("as if by mistake")

    with PseudoTerminal(tmp_path / "port") as cable, monkeypatch.context() as patch:
        patch.setattr(driver._framing, "cut", fail)
        async with running(driver):
            await eventually(lambda: driver.link.state == "up", "the port is open")
            os.write(cable.fd, b"1,1\n")
            await eventually(lambda: driver.counters.reader_failures == 1, "the failure is counted")
            patch.undo()
            await eventually(lambda: driver.link.losses == 1, "the link is given up")
            await eventually(lambda: driver.link.state == "up", "the port is open again")
            os.write(cable.fd, b"1,1\n2,2\n3,3\n")
            await eventually(lambda: driver.streams["x"][0].frames_received > 1, "samples arrive")
    assert "as if by mistake" in caplog.text


async def test_reading_goes_on_while_a_batch_is_cut_and_all_is_told_in_order(tmp_path: Path) -> None:
    told: list[str] = []
    blocks: list[SampleBlock] = []
    driver = lines_driver(tmp_path / "port", blocks, checksum="xor")
    begun, released = threading.Event(), threading.Event()
    cut, accept, tick = driver._framing.cut, driver.accept, driver.tick

    def slowly(data: bytes, arrivals_of: Any) -> Any:
        begun.set()
        assert released.wait(PATIENCE_S)
        return cut(data, arrivals_of)

    def noted(batch: DecodedBatch) -> None:
        told.append(f"{batch.notes['bytes_received']} bytes")
        accept(batch)

    driver._framing.cut = slowly  # type: ignore[method-assign]
    driver.accept = noted  # type: ignore[method-assign]
    driver.tick = lambda now_ns: (told.append("quiet"), tick(now_ns))[1]  # type: ignore[method-assign]
    lines = driver._framing.encode("x", np.arange(2), np.ones((2, 1, 1)))
    with PseudoTerminal(tmp_path / "port") as cable:
        async with running(driver):
            await eventually(lambda: driver.link.state == "up", "the port is open")
            reader = next(t for t in threading.enumerate() if isinstance(t, serial_reader.SerialReader))
            os.write(cable.fd, lines[0])
            await eventually(begun.is_set, "the first batch is being cut")
            await asyncio.sleep(0)
            told.clear()
            waiting = reader._jobs.qsize()
            os.write(cable.fd, lines[1])
            # Two more: one may still say that nothing had come by then.
            await eventually(lambda: reader._jobs.qsize() > waiting + 1, "reading goes on")
            assert told == []
            cable.unplug()
            await eventually(lambda: not reader.is_alive(), "the port has been found gone")
            assert driver.link.state == "up"
            released.set()
            await eventually(lambda: driver.link.losses == 1, "the link is lost")
    assert [what for what in told if what != "quiet"] == [f"{len(line)} bytes" for line in lines]
    assert told[0] != "quiet"
    assert "quiet" in told[1:]
    assert sum(len(block.samples) for block in blocks) == 2


@pytest.mark.long
def test_overtaken_lines_and_numbers_beyond_all_bounds_cost_no_sample(tmp_path: Path) -> None:
    stamped = line_layout(("t", "x"), ("x",), time="t", unit="ms")
    specs = [StreamSpec("x", stamped, 100.0)]
    bus = serial_bus(port=str(tmp_path), framing="lines")
    blocks: list[SampleBlock] = []
    driver = SerialDriver(bus, BusPort("ser0", specs, DrivenClock(), blocks.append))
    lines = [b"%d,%d\n" % (10 * k, k) for k in range(800)]
    lines[300], lines[310], lines[320] = b"3000,1e999\n", b"3100,1e39\n", b"3200,-1e400\n"
    lines[500], lines[501] = lines[501], lines[500]
    framing = framing_of(bus, specs)
    for k, line in enumerate(lines):
        driver.accept(framing.cut(line, lambda ends, k=k: np.full(len(ends), 10_000_000 * k)))
    driver._assemblers["x"].flush()
    values = np.concatenate([block.samples[:, 0] for block in blocks])
    expected = np.arange(1, 800, dtype=np.float32)
    expected[[299, 309, 319]] = np.nan
    np.testing.assert_array_equal(values, expected)
    counters, time_base = driver.streams["x"]
    assert (counters.samples_received, counters.samples_lost, counters.values_absent) == (799, 0, 3)
    assert (counters.frames_reordered, counters.frames_rejected, time_base.restarts) == (1, 0, 0)


def test_lines_with_neither_counter_nor_time_are_placed_and_counted_by_their_arrival(tmp_path: Path) -> None:
    layout = line_layout(("x",), ("x",), no_counter=True)
    specs = [StreamSpec("x", layout, 100.0)]
    bus = serial_bus(port=str(tmp_path), framing="lines")
    blocks: list[SampleBlock] = []
    driver = SerialDriver(bus, BusPort("ser0", specs, DrivenClock(), blocks.append))
    framing = framing_of(bus, specs)
    # Forty lines do not come.
    for k in [*range(300), *range(340, 800)]:
        driver.accept(framing.cut(b"%d\n" % k, lambda ends, k=k: np.full(len(ends), 10_000_000 * k)))
    driver._assemblers["x"].flush()
    values = np.concatenate([block.samples[:, 0] for block in blocks])
    np.testing.assert_array_equal(values, np.float32([*range(1, 300), *range(340, 800)]))
    counters, _ = driver.streams["x"]
    assert (counters.samples_received, counters.samples_lost, counters.gaps) == (759, 40, 1)
    assert blocks[-1].first_index + len(blocks[-1].samples) == 799


@pytest.mark.parametrize(
    ("bad", "words"), [(b"%d,9\n", "only 66.67 of 100 Hz can be read"), (b"", "sends 66.67 Hz")]
)
def test_lines_that_cannot_be_read_are_no_other_rate(tmp_path: Path, bad: bytes, words: str) -> None:
    layout = line_layout(("x",), ("x",), no_counter=True)
    specs = [StreamSpec("x", layout, 100.0)]
    bus = serial_bus(port=str(tmp_path), framing="lines")
    driver = SerialDriver(bus, BusPort("ser0", specs, DrivenClock(), lambda _: None))
    framing = framing_of(bus, specs)
    for k in range(2000):
        line = bad % k if k % 3 == 1 and bad else b"" if k % 3 == 1 else b"%d\n" % k
        driver.accept(framing.cut(line, lambda ends, k=k: np.full(len(ends), 10_000_000 * k)))
    _, time_base = driver.streams["x"]
    assert words in time_base.doubt


def test_why_no_samples_come_is_stated_while_lines_come_that_are_none_of_the_layout(tmp_path: Path) -> None:
    clock, specs = DrivenClock(), [StreamSpec("x", LINE, 100.0)]
    bus = serial_bus(port=str(tmp_path), framing="lines")
    driver = SerialDriver(bus, BusPort("ser0", specs, clock, lambda _: None))
    driver.link.up()
    framing = framing_of(bus, specs)
    driver.accept(framing.cut(b"0\n1,2,3\n"))
    why = 'bytes come on ser0, but no line as its layout states; the first line is "1,2,3": 3 columns'
    assert driver.link.why_silent("x").startswith(why)
    driver.accept(framing.cut(b"4,5,6\n"))
    assert driver.link.why_silent("x").startswith(why)
    driver.accept(framing.cut(b"7,8\n"))
    assert driver.link.why_silent("x") == ""
    driver.accept(framing.cut(b"9,8,7\n"))
    clock.advance_to(clock.monotonic_ns() + RECENT_NS)
    driver.tick(clock.monotonic_ns())
    assert driver.link.why_silent("x").startswith(why)
    # By now nothing comes at all.
    clock.advance_to(clock.monotonic_ns() + 1)
    driver.tick(clock.monotonic_ns())
    assert driver.link.why_silent("x") == ""


@pytest.mark.gives("B34")
def test_what_is_wrong_with_all_lines_now_is_stated_though_a_header_came_first(caplog: Any) -> None:
    layout = line_layout(("seq", "x"), ("x",), counter="seq", bits=16)
    clock, specs = DrivenClock(), [StreamSpec("x", layout, 100.0)]
    bus = serial_bus(port="/var/lib/daqsvc/port", framing="lines")
    driver = SerialDriver(bus, BusPort("ser0", specs, clock, lambda _: None))
    driver.link.up()
    framing = framing_of(bus, specs)
    header = b"count,temp\n"
    driver.accept(framing.cut(b"0,1\n" + header + b"65534,1\n"))
    driver.accept(framing.cut(header))
    assert '"count,temp"' in driver.link.why_silent("x")
    for count in range(65_536, 65_560):
        driver.accept(framing.cut(header * (count % 8 == 0) + b"%d,1\n" % count))
    assert 'the last line is "65' in driver.link.why_silent("x")
    assert "by its bits in the file 65535 at most" in driver.link.why_silent("x")
    said = [record.message for record in caplog.records if "no frame" in record.message]
    assert len(said) == 2
    assert '"count,temp"' in said[0]
    assert said[1].endswith("correct bits of counter")


def test_noise_of_all_sorts_does_not_fill_the_log(caplog: Any) -> None:
    clock, specs = DrivenClock(), [StreamSpec("x", LINE, 100.0)]
    bus = serial_bus(port="/var/lib/daqsvc/port", framing="lines")
    driver = SerialDriver(bus, BusPort("ser0", specs, clock, lambda _: None))
    framing = framing_of(bus, specs)
    for columns in range(2, 50):
        driver.accept(framing.cut(b"7\n" + 4 * (b",".join([b"1"] * columns) + b"\n")))
    assert 1 < sum("no frame" in record.message for record in caplog.records) <= 4


async def test_a_port_is_not_silent_while_its_kernels_are_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = threading.Event()
    monkeypatch.setattr(serial_driver, "_warm", lambda *_: compiled.wait(PATIENCE_S))
    with PseudoTerminal(tmp_path / "port"):
        driver = lines_driver(tmp_path / "port", [])
        assert not driver.link.preparing
        async with running(driver):
            await eventually(lambda: driver.link.preparing)
            compiled.set()
            await eventually(lambda: driver.link.state == "up")
            assert not driver.link.preparing
