"""The machine files of the demo: the paper's rig, and one made to measure for a recording.

A recording is played if a device could send it and the service could use it, else refused (`playable`);
one of the healthy machine gives setpoints.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from fractions import Fraction
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from daqsvc.bearing.geometry import bearing_orders
from daqsvc.detectors.rotor_bank.settings import RotorBank
from daqsvc.errors.command_line import SIMULATION
from daqsvc.publish.mqtt.settings import Mqtt
from daqsvc.settings import MachineFile, MachineFileError, parse_machine_file

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.recording.recording import Recording
    from sim_hw.scenario import Scenario


class DemoError(Exception):
    """The demo cannot run; the message states why and what to do."""

    code = SIMULATION


CHANNEL = "daqsvc-demo"
HEADROOM = 1.25
"""Full scale of a recording's channel over its largest value."""

PAYLOAD_BYTES = 64
HEADER_BYTES = 2
CRC_BYTES = 2
SAMPLE_BYTES = 2
MOST_CHANNELS = 8

SENSOR_TYPES: Mapping[str, str] = {
    "g": "accelerometer",
    "m/s2": "accelerometer",
    "mm/s": "velocity",
    "um": "proximity",
    "mm": "proximity",
    "mil": "proximity",
}


AlarmLimits: TypeAlias = dict[str, tuple[float, float]]
"""Alert and danger limit of the RMS, by channel."""


@dataclass(frozen=True, slots=True)
class PlayedBearing:
    """The bearing that every channel of a recording is watched for.

    Attributes:
        designation: its name in the catalogue.
        speed_rpm: of the shaft.

    Raises:
        DemoError: the catalogue does not know it.
    """

    designation: str
    speed_rpm: float

    def __post_init__(self) -> None:
        try:
            bearing_orders(self.designation)
        except KeyError as error:
            raise DemoError(f"--bearing: {error.args[0]}") from None

    def tables(self, sensors: Sequence[str]) -> str:
        """Detector and alarm of a machine file."""
        watched = [
            f"""[[pipeline.bearing.bearings]]
name = "{sensor}"
sensor = "{sensor}"
type = {json.dumps(self.designation)}
"""
            for sensor in sensors
        ]
        return "".join(
            [
                "[pipeline.bearing]\n",
                *watched,
                """[[alarms]]
name = "bearing-damage"
detector = "bearing"
latching = true
""",
            ]
        )


def laval_rig(scenario: Scenario, noise_um: float, url: str) -> MachineFile:
    """The rig of the paper, at the scenario's speed, rate, rotor and noise."""
    text = resources.files(__package__).joinpath("laval-rig.toml").read_text("utf-8")
    rig = parse_machine_file(text, Path("laval-rig.toml"))
    assert rig.machine.rotor is not None  # noqa: S101 - the file next to this one has it
    bank = rig.pipeline.table(RotorBank)
    assert bank is not None  # noqa: S101
    mqtt = rig.output(Mqtt)
    assert mqtt is not None  # noqa: S101
    plant, rotor = scenario.plant, scenario.plant.rotor
    described = rig.machine.rotor.model_copy(
        update={
            "natural_frequency_hz": plant.speed_rpm / 60.0 / rotor.speed_ratio,
            "damping_ratio": rotor.damping_ratio,
            "eccentricity_um": rotor.eccentricity * plant.clearance_um,
            "heavy_spot_deg": rotor.heavy_spot_deg,
            "clearance_um": plant.clearance_um,
            "static_sag_um": rotor.gravity / rotor.stiffness * plant.clearance_um,
            "contact_stiffness": rotor.contact_stiffness,
        }
    )
    bank = bank.model_copy(update={"noise_um": noise_um})
    return rig.model_copy(
        update={
            "machine": rig.machine.model_copy(update={"speed_rpm": plant.speed_rpm, "rotor": described}),
            "streams": {"shaft": rig.streams["shaft"].model_copy(update={"rate_hz": scenario.rate_hz})},
            "pipeline": rig.pipeline.model_copy(update={"rotor_bank": bank}),
            "mqtt": mqtt.model_copy(update={"url": url}),
        }
    )


def for_recording(
    recording: Recording,
    unit: str,
    setpoints: AlarmLimits,
    url: str,
    bearing: PlayedBearing | None = None,
) -> MachineFile:
    """A machine with one sensor per channel of a recording, int16 samples over CAN FD.

    Args:
        recording: what its sensors show.
        unit: of the channels.
        setpoints: of the alarms, by channel.
        url: of the broker.
        bearing: what the channels are watched for; None: no bearing.

    Raises:
        DemoError: more channels than a frame has room for, or the service could not diagnose it. It states it
            in words of the recording, as the machine file that is made of it is not shown.
    """
    names = recording.names
    if len(names) > MOST_CHANNELS:
        raise DemoError(
            f"{recording.source} gives {len(names)} channels ({', '.join(names)}); "
            f"choose at most {MOST_CHANNELS} of them with --map"
        )
    room = PAYLOAD_BYTES - HEADER_BYTES - CRC_BYTES
    tables = [
        f"""schema_version = 1
site = "demo"
box = "virtual"
[machine]
name = "recorded-machine"
description = {json.dumps(str(recording.source).encode(errors="replace").decode())}
speed_rpm = {1800.0 if bearing is None else bearing.speed_rpm!r}
[buses.can0]
driver = "can"
interface = "virtual"
channel = "{CHANNEL}"
fd = true
[streams.recording]
bus = "can0"
rate_hz = {float(recording.rate_hz)!r}
[streams.recording.layout]
id = 0x201
length = {PAYLOAD_BYTES}
counter = {{ byte = 0, bits = 16, counts = "samples" }}
first_byte = {HEADER_BYTES}
samples_per_frame = {room // (SAMPLE_BYTES * len(names))}
crc_byte = {PAYLOAD_BYTES - CRC_BYTES}
[pipeline]
ring_s = 10.0
[pipeline.levels]
window_s = 0.5
velocity_band_hz = [10.0, {min(1000.0, 0.4 * recording.rate_hz)!r}]
[recorder]
after_s = 5.0
max_mb = 100
[mqtt]
url = "{url}"
insecure = true
protocol = "3.1.1"
"""
    ]
    for column, name in enumerate(names):
        scale = _scale(recording.samples[:, column])
        tables.append(
            f"""[[streams.recording.layout.channels]]
name = "{name}"
type = "int16"
scale = {scale!r}
[[sensors]]
name = "{name}"
type = "{SENSOR_TYPES[unit]}"
stream = "recording"
channel = "{name}"
unit = "{unit}"
{"gap_ok_v = [-18.0, -2.0]" if SENSOR_TYPES[unit] == "proximity" else ""}
"""
        )
        if name in setpoints:
            alert, danger = setpoints[name]
            tables.append(
                f"""[[alarms]]
name = "vibration-{name}"
sensor = "{name}"
measure = "rms"
alert = {alert!r}
danger = {danger!r}
deadband = {0.05 * alert!r}
"""
            )
    if bearing is not None:
        tables.append(bearing.tables(names))
    try:
        return parse_machine_file("".join(tables), Path("recorded-machine.toml"))
    except MachineFileError as error:
        raise _in_words(error, recording) from error


def _in_words(error: MachineFileError, recording: Recording) -> DemoError:
    """What is wrong with the file made of a recording, as the recording's and the options' fault."""
    messages: list[str] = []
    remedies: dict[str, None] = {}
    for problem in error.problems:
        of_levels = problem.key.startswith("pipeline")
        key = problem.key.rpartition(".")[2]
        messages.append(problem.message if of_levels or not problem.value else f"{key} {problem.message}")
        remedies |= dict.fromkeys(
            [
                "correct the sampling rate (--fs)"
                if of_levels
                else "give another baseline (--baseline)"
                if problem.key.startswith("alarms")
                else "choose and name the channels with --map"
            ]
        )
    return DemoError(
        f"{recording.source} cannot be played at {recording.rate_hz:g} Hz as {', '.join(recording.names)}: "
        f"{'; '.join(messages)}. Remedy: {', or '.join(remedies)}"
    )


def _scale(samples: NDArray[np.float64]) -> float:
    """Worth of one count: a power of two, so that scaling is exact in binary."""
    largest = float(np.nanmax(np.abs(samples))) or 1.0
    return float(2.0 ** np.ceil(np.log2(largest * HEADROOM / 2**15)))


WINDOW_S = 0.5
ALERT = 1.5
DANGER = 3.0
"""Limits over the loudest window of the healthy machine."""

MOST_RATIO = 1000


def setpoints(healthy: Recording, rate_hz: float) -> AlarmLimits:
    """Alert and danger limits of the RMS of each channel.

    The healthy recording is first brought to the rate of the one it is compared with: at a higher rate
    it would hold vibration that the other cannot.

    Args:
        healthy: recording of the healthy machine.
        rate_hz: rate of the recording to come.

    Raises:
        DemoError: the recording is shorter than one window, or a channel of it does not move.
    """
    # Imported here: it takes over a second, and only --baseline needs it.
    from scipy.signal import resample_poly  # noqa: PLC0415

    ratio = Fraction(rate_hz / healthy.rate_hz).limit_denominator(MOST_RATIO)
    levels: AlarmLimits = {}
    for column, name in enumerate(healthy.names):
        samples: NDArray[np.float64] = healthy.samples[:, column]
        if np.ptp(samples) == 0.0:
            raise DemoError(
                f"baseline {healthy.source} does not move: every sample of {name} is {samples[0]:g}; "
                "give a recording of the running machine"
            )
        if ratio != 1:
            samples = resample_poly(samples - samples.mean(), ratio.numerator, ratio.denominator)
        size = round(WINDOW_S * rate_hz)
        count = len(samples) // size
        if not count:
            raise DemoError(
                f"baseline {healthy.source} lasts {len(samples) / rate_hz:.2f} s; give at least {WINDOW_S} s"
            )
        windows = samples[: count * size].reshape(count, size)
        loudest = float(windows.std(axis=1).max())
        levels[name] = (ALERT * loudest, DANGER * loudest)
    return levels


LONGEST_NAME = 64


def playable(recording: Recording) -> Recording:
    """The recording with names that sensors can have.

    Raises:
        DemoError: it holds NaN or infinite samples, is too short, or a name cannot be made a sensor's.
    """
    _check_samples(recording)
    duration_s = len(recording.samples) / recording.rate_hz
    if duration_s < WINDOW_S:
        raise DemoError(
            f"{recording.source} is too short: {len(recording.samples)} samples at {recording.rate_hz:g} Hz "
            f"last {duration_s:.3g} s; give at least {WINDOW_S} s, or correct --fs"
        )
    return replace(recording, names=_sensor_names(recording))


def _check_samples(recording: Recording) -> None:
    counted = [(recording.nan_count, "NaN"), (recording.infinity_count, "infinite")]
    if kinds := " and ".join(f"{count} {kind}" for count, kind in counted if count):
        holding = [
            name
            for column, name in enumerate(recording.names)
            if not np.isfinite(recording.samples[:, column]).all()
        ]
        raise DemoError(
            f"{recording.source} holds {kinds} samples (in {', '.join(holding)}), which no device could "
            "send; cut them out or interpolate them"
        )


def _sensor_names(recording: Recording) -> tuple[str, ...]:
    originals: dict[str, str] = {}
    for original in recording.names:
        name = re.sub(r"[^A-Za-z0-9_.-]+", "-", original).strip("-")
        remedy = "name its sensor with --map NAME=VARIABLE"
        if not name:
            raise DemoError(f"{recording.source}: no sensor can be named {original!r}; {remedy}")
        if len(name) > LONGEST_NAME:
            raise DemoError(
                f"{recording.source}: {name!r} is longer than the {LONGEST_NAME} characters of a sensor's "
                f"name; {remedy}"
            )
        if name in originals:
            raise DemoError(
                f"{recording.source}: {originals[name]!r} and {original!r} would both be sensor {name!r}; "
                f"{remedy}"
            )
        originals[name] = original
    return tuple(originals)
