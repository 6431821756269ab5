# ruff: noqa: E501 - TOML in one line each
"""Machine files with a bus of every kind, each with a rogue device on it, and a sound bus."""

from __future__ import annotations

from typing import TYPE_CHECKING

from support.rogue_devices import FIFO, NOMINAL_HZ, RING, RING_PLACES, TREND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from support.rogue_devices import RogueDevices

HEAD = """
schema_version = 1
site = "lab"
box = "edge-1"
[machine]
name = "pump"
speed_rpm = 600.0
[pipeline]
ring_s = 20.0
[pipeline.levels]
window_s = 0.5
velocity_band_hz = [5.0, 20.0]
"""
BUS = {
    "sound": 'driver = "can"\ninterface = "unixbus"\nchannel = "{folder}/can-sound"\nfd = true',
    "can": 'driver = "can"\ninterface = "unixbus"\nchannel = "{folder}/can-rogue"\nfd = true',
    "cobs": 'driver = "serial"\nport = "{folder}/cobs"\nbaud = 921_600\nframing = "cobs"',
    "sync": 'driver = "serial"\nport = "{folder}/sync"\nbaud = 921_600\nframing = "sync"\nsync_word = "a55a"',
    "lines": 'driver = "serial"\nport = "{folder}/lines"\nbaud = 921_600\nframing = "lines"',
    "tcp": 'driver = "modbus"\ntransport = "tcp"\nhost = "127.0.0.1"\ntcp_port = {tcp_port}\ntimeout_ms = 50.0',
    "rtu": 'driver = "modbus"\ntransport = "rtu"\nserial_port = "{folder}/rtu"\nbaud = 115_200\ntimeout_ms = 50.0',
    "replay": 'driver = "replay"\nfile = "{folder}/rogue.log"\nat_end = "loop"',
}
CHANNEL = 'channels = [{ name = "x", type = "int16", scale = 0.001 }]'
COUNTER = 'counter = { byte = 0, bits = 32, counts = "samples" }\nfirst_byte = 4'
CAN = f"id = 0x101\nlength = 8\n{COUNTER}\nsamples_per_frame = 1\ncrc_byte = 6\n{CHANNEL}"
BINARY = f"payload_length = 6\n{COUNTER}\nsamples_per_frame = 1\n{CHANNEL}"
PLACE = 'channels = [{ name = "x", place = 0, type = "int16", scale = 0.001 }]'
RING_LAYOUT = (
    f'way = "ring"\nunit = 1\ncount = {{ address = {RING}, bits = 32 }}\naddress = {RING_PLACES.start}\n'
    f"depth = {len(RING_PLACES)}\n{PLACE}"
)
FIFO_LAYOUT = f'way = "fifo"\nunit = 1\ncount = {{ bits = 32 }}\naddress = {FIFO}\n{PLACE}'
TREND_LAYOUT = (
    f'way = "registers"\nunit = 1\nchannels = [{{ name = "x", address = {TREND}, type = "float32" }}]'
)
LAYOUT = {
    "sound": CAN.replace("length = 8", "length = 32").replace("samples_per_frame = 1", "samples_per_frame = 10")
    .replace("crc_byte = 6", "crc_byte = 30"),
    "can": CAN,
    "replay": CAN,
    "cobs": BINARY,
    "sync": BINARY,
    "lines": 'line = ["seq", "x"]\ncounter = { column = "seq", bits = 32 }\nchannels = [{ name = "x" }]',
    "tcp": RING_LAYOUT,
    "tcp-fifo": FIFO_LAYOUT,
    "tcp-trend": TREND_LAYOUT,
    "rtu": RING_LAYOUT,
}  # fmt: skip


def machine_text(kinds: Sequence[str], devices: RogueDevices) -> str:
    """A sound stream of 1000 Hz, and a stream, or three, on each rogue's bus."""
    parts = [HEAD]
    for bus in ("sound", *kinds):
        parts.append(f"[buses.{bus}]\n{BUS[bus].format(folder=devices.folder, tcp_port=devices.tcp_port)}\n")
        for stream in (name for name in LAYOUT if name.partition("-")[0] == bus):
            rate_hz = 1000.0 if stream == "sound" else 10.0 if stream.endswith("trend") else NOMINAL_HZ
            kind = (
                'type = "trend"\nunit = "degC"'
                if stream.endswith("trend")
                else 'type = "accelerometer"\nunit = "g"'
            )
            parts.append(
                f'[streams.{stream}]\nbus = "{bus}"\nrate_hz = {rate_hz}\n'
                f"[streams.{stream}.layout]\n{LAYOUT[stream]}\n"
                f'[[sensors]]\nname = "s-{stream}"\nstream = "{stream}"\nchannel = "x"\n{kind}\n'
            )
    return "\n".join(parts)
