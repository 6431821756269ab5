"""The machine files of the soak: a machine on a bus of every kind, and one that comes and goes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from soak.devices import Plant

ALARM = "shaking"
SETPOINTS_G = (2.0, 2.5)
"""Between what a calm device measures and what a loud one does."""

HEAD = """
schema_version = 1
site = "lab"
box = "soak"

[machine]
name = "{name}"
speed_rpm = 600.0

[alarm_handling]
chatter_raises = 0               # each time that it comes and goes is to be told

[pipeline]
ring_s = 10.0

[pipeline.levels]
window_s = 1.0
velocity_band_hz = [5.0, 20.0]

[[sensors]]
name = "accel"
type = "accelerometer"
stream = "casing"
channel = "x"
unit = "g"

[[alarms]]
name = "shaking"
sensor = "accel"
measure = "rms"
alert = 2.0
deadband = 0.2

[buses.{bus}]
start = "retry"
{table}

[streams.casing]
bus = "{bus}"
rate_hz = {rate_hz}

[streams.casing.layout]
{layout}
"""

SHARED = """
[store]
directory = "{store}"
alarms_max_mb = 16
telemetry_max_mb = 1
reserve_mb = 4

[mqtt]
url = "mqtt://127.0.0.1:{broker}"
insecure = true
"""

ANOTHER_SENSOR = """
[[sensors]]
name = "count"
type = "trend"
stream = "temperature"
channel = "again"
unit = "degC"
"""

TREND = """
[streams.temperature]
bus = "tcp"
rate_hz = 2.0

[streams.temperature.layout]
way = "registers"
unit = 2
channels = [
  { name = "t", address = 400, type = "float32" },
  { name = "again", address = 402, type = "float32" },
]

[[sensors]]
name = "temperature"
type = "trend"
stream = "temperature"
channel = "t"
unit = "degC"
"""

PACKED = (
    'channels = [{ name = "x", type = "int16", scale = 0.001 }, { name = "n", type = "uint24", scale = 1.0 }]'
)
PLACES = (
    'channels = [{ name = "x", place = 0, type = "int16", scale = 0.001 },'
    ' { name = "n", place = 1, type = "uint32", scale = 1.0 }]'
)
RING_DEPTH = 1024
"""Ten seconds: whoever comes back later has lost samples, and a busy machine loses none."""
RING = (
    'way = "ring"\nunit = 1\ncount = { address = 0, bits = 32 }\naddress = 16\n'
    f"depth = {RING_DEPTH}\n{PLACES}"
)
LINES = 'framing = "lines"\nbaud = 115_200'
LINE = 'line = ["seq", "x", "n"]\ncounter = { column = "seq" }\nchannels = [{ name = "x" }, { name = "n" }]'
CAN = 'driver = "can"\ninterface = "unixbus"\nfd = true\noptions = { hub = "join" }'
COUNTER = 'counter = {{ byte = 0, bits = {bits}, counts = "samples" }}\nfirst_byte = 4'


def machine_files(plant: Plant, store: Path, broker: int) -> dict[str, str]:
    """Texts of the machine files by the names of the machines; `SPARE` is the one that comes and goes."""
    folder = plant.folder
    serial = 'driver = "serial"\nport = "{}"'
    modbus = 'driver = "modbus"\ntimeout_ms = 500.0'
    shared = SHARED.format(store=store, broker=broker)
    kinds = {
        "pump": (
            "can0",
            f'{CAN}\nchannel = "{folder / "can0"}"',
            f"id = 0x101\nlength = 64\n{COUNTER.format(bits=16)}\nsamples_per_frame = 10\n{PACKED}",
            shared,
        ),
        "fan": (
            "tcp",
            f'{modbus}\ntransport = "tcp"\nhost = "127.0.0.1"\ntcp_port = {plant.tcp_port}',
            RING,
            TREND,
        ),
        "gear": (
            "rtu",
            f'{modbus}\ntransport = "rtu"\nserial_port = "{folder / "rtu"}"\nbaud = 115_200',
            RING,
            "",
        ),
        "mill": (
            "cobs",
            serial.format(folder / "cobs") + '\nframing = "cobs"\nbaud = 115_200',
            f"payload_length = 24\n{COUNTER.format(bits=32)}\nsamples_per_frame = 4\n{PACKED}",
            "",
        ),
        "saw": ("lines", serial.format(folder / "lines") + f"\n{LINES}", LINE, ""),
        SPARE: ("spare", serial.format(folder / "spare") + f"\n{LINES}", LINE, ""),
    }
    return {
        name: HEAD.format(name=name, bus=bus, table=table, layout=layout, rate_hz=plant.devices[name].rate_hz)
        + more
        for name, (bus, table, layout, more) in kinds.items()
    }


SPARE = "lathe"
BUS_OF = {
    "pump": "can0", "fan": "tcp", "gear": "rtu", "mill": "cobs", "saw": "lines", SPARE: "spare",
}  # fmt: skip
"""The bus of each machine."""
