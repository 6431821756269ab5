"""The sensors, detectors and alarms of a new machine file: questions and tables."""

from __future__ import annotations

import math
import re
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from daqsvc.commands.new.buses import bus_of
from daqsvc.commands.new.topics import SENSOR_TOPICS, TOPICS
from daqsvc.rounding import rounded_up
from daqsvc.settings.measures import (
    ISO_BAND_HZ,
    SAMPLES_PER_PERIOD,
    SLOW_BAND_HZ,
    SLOW_RPM,
    highest_hz,
    shows_1x,
)
from daqsvc.settings.units import factor_between, is_of_peak, same_unit, unit_of
from drivers import questions as q
from drivers.names import SENSOR_PREFIX, sensor_name, unused
from drivers.questions import NONE, Answers, Question, sensor_key
from drivers.sniffing import TYPE_OF_UNIT, plain_name
from drivers.toml_lines import array, behind, entry, toml

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from daqsvc.settings.zones import Boundaries

TYPES = {
    "proximity": "a proximity probe, which sees the shaft",
    "accelerometer": "on the housing",
    "velocity": "a velocity sensor on the housing",
    "keyphasor": "one pulse a revolution",
    "trend": "a value that the device measures itself, e.g. velocity RMS, temperature",
    NONE: "nothing that is of interest",
}
_UNITS = {"proximity": ("um", "mm", "mil"), "accelerometer": ("g", "m/s2", "mg", "mm/s2")}
_NO_UNIT = "1"
_FIXED_UNITS = {"velocity": "mm/s", "keyphasor": "V"}
_SENSITIVITY = {
    "um": 7.87,
    "mm": 7870.0,
    "mil": 200.0,
    "g": 100.0,
    "m/s2": 10.2,
    "mg": 0.1,
    "mm/s2": 0.0102,
    "mm/s": 4.0,
}
_ZERO_V, _OK_V = -10.0, (-18.0, -2.0)
CLASSES = {
    "2-rigid": "15 to 300 kW on a stiff foundation",
    "2-flexible": "15 to 300 kW on a soft one, e.g. on springs or a steel frame",
    "1-rigid": "above 300 kW on a stiff foundation",
    "1-flexible": "above 300 kW on a soft one",
}
_SHAFT_ALERTS = {"um": "100", "mm": "0.1", "mil": "4"}
"""Peak to peak, to begin with: what is right depends on the speed (ISO 20816-3)."""
_SIMULATED_ALERTS = {"um": "35", "mm": "0.035", "mil": "1.4"}
"""RMS, between the healthy and the faulty machine that `daqsvc sim` plays."""
_ISO_RPM = (120.0, 30_000.0)
"""Speeds that ISO 20816-3 is for."""
_BEARING_RATE_HZ, _BEARING_RPM, _BEARING_BLOCK_S = 2500.0, 600.0, 1.25
"""What the bearings' detector needs."""
_PULSE_SAMPLES, _HARMONIC_SAMPLES = 4.0, 12.0
"""Samples a revolution that a keyphasor's pulses, and 1X by them, need."""
_LONGEST_WINDOW_S = 10.0


_NO_RMS = re.compile(
    r"peak|max(?:imum)?(?![a-z])|set_?point|limit|(?:belt|conveyor|feed)_?(?:speed|rate|vel)|pk(?=[_\d]|$)"
    r"|spitz|scheitel|maximal|hoe?chstwert|grenz|soll|vorgabe|schwelle?n?_?wert|(?:alarm|warn)_?wert"
    r"|(?:band|foe?rder|transport|vorschub)_?(?:geschw|v(?![a-z]))|vorschub(?![a-z])"
)
"""In names of channels in mm/s that are no RMS of a vibration: zones of ISO 20816-3 are not for them.

In English and German, in small letters; also where ö is written as o.
"""
_RMS = re.compile(r"R(?:MS|ms)|E(?:FF|ff)|(?<![A-Za-z])(?:rms|eff)|(?:rms|eff)(?![A-Za-z])|effektiv")
"""In names of those that are, whatever else is in them; but no part of AlarmSetpoint."""


class Sensor(NamedTuple):
    """A sensor, as it was answered."""

    channel: str
    name: str
    type: str
    unit: str
    bearing: Any
    shows_speed: bool
    """Whether a velocity RMS of it has 1X of the machine in its band."""
    simulated: bool
    """Whether `daqsvc sim` plays it: with so much noise that its peaks hardly show a fault."""

    @property
    def housing(self) -> bool:
        """Whether it sends the vibration of the housing."""
        return self.type in {"accelerometer", "velocity"}

    @property
    def measure(self) -> tuple[str, str] | None:
        """The measure that its limits are for, and the unit of that."""
        if self.housing:
            return ("velocity_rms", "mm/s") if self.shows_speed else ("rms", self.unit)
        # Limits of shaft vibration are from peak to peak (API 670, ISO 20816): as an RMS they are too high.
        of_shaft = "rms" if self.simulated else "peak_to_peak"
        return {"proximity": (of_shaft, self.unit), "trend": ("value", self.unit)}.get(self.type)

    @property
    def no_rms(self) -> bool:
        """Whether it is a value in mm/s that is no RMS by its unit, or hardly by the name of its channel."""
        if self.type != "trend" or not same_unit(self.unit, "mm/s"):
            return False
        if is_of_peak(self.unit):
            return True
        is_named_rms = any(_RMS.search(name) for name in (self.channel, self.name))
        return not is_named_rms and _NO_RMS.search(plain_name(self.channel)) is not None

    @property
    def iso(self) -> str | None:
        """Which zones of ISO 20816-3 are there for it: ``housing`` or ``shaft``."""
        if self.type == "proximity":
            return "shaft"
        measured_there = self.type == "trend" and self.unit == "mm/s"
        if measured_there and self.no_rms:
            return None
        return "housing" if measured_there or (self.housing and self.shows_speed) else None


def sensors(answers: Answers) -> list[Sensor]:
    """The sensors as far as they have been answered."""
    answered = []
    band_hz = _band_hz(answers)
    shows_speed = band_hz is not None and band_hz[0] <= abs(answers.get("speed", math.inf)) / 60.0
    for channel in bus_of(answers).channels(answers):
        kind = answers.get(sensor_key(channel, "type"), NONE)
        if kind != NONE and sensor_key(channel, "name") in answers:
            unit = _FIXED_UNITS.get(kind) or answers.get(sensor_key(channel, "unit"), "")
            bearing = answers.get(sensor_key(channel, "bearing"))
            answered.append(
                Sensor(
                    channel,
                    answers[sensor_key(channel, "name")],
                    kind,
                    unit,
                    bearing,
                    shows_speed,
                    simulated=bus_of(answers).simulated,
                )
            )
    return answered


def _lowest_hz(answers: Answers) -> float:
    """Where the velocity of ISO 20816-3 begins."""
    return (SLOW_BAND_HZ if abs(answers["speed"]) <= SLOW_RPM else ISO_BAND_HZ)[0]


def _band_hz(answers: Answers) -> tuple[float, float] | None:
    """The band of the velocity RMS; None where the samples are too slow for one with 1X in it."""
    if "rate" not in answers or "speed" not in answers:
        return ISO_BAND_HZ
    low_hz = _lowest_hz(answers)
    if not shows_1x(answers["rate"], answers["speed"], low_hz):
        return None
    return low_hz, min(ISO_BAND_HZ[1], highest_hz(answers["rate"]))


def notes_on_velocity(answers: Answers) -> list[str]:
    """What the velocity RMS does not hold at this rate, if anything watches or would watch it."""
    housing = [one for one in sensors(answers) if one.housing]
    if not housing:
        return []
    band_hz = _band_hz(answers)
    if band_hz is None:
        return [f"There is no velocity RMS of {', '.join(one.name for one in housing)}. {_too_slow(answers)}"]
    if answers.get("limits") == "iso" and band_hz[1] < ISO_BAND_HZ[1]:
        narrow = (
            f"The velocity RMS is of {band_hz[0]:g} Hz to {band_hz[1]:g} Hz, as samples come at "
            f"{answers['rate']:g} Hz. That is less than the {band_hz[0]:g} Hz to {ISO_BAND_HZ[1]:g} Hz of "
            "ISO 20816-3: what vibrates faster is not in it."
        )
        return [narrow]
    return []


def _too_slow(answers: Answers) -> str:
    """Why there is no velocity RMS, and so no zones, and what to do."""
    rate_hz, once_hz = answers["rate"], abs(answers["speed"]) / 60.0
    least_hz = SAMPLES_PER_PERIOD * max(once_hz, _lowest_hz(answers))
    return (
        f"{rate_hz:g} samples a second show frequencies up to {highest_hz(rate_hz):g} Hz; the shaft turns at "
        f"{once_hz:.3g} Hz, and the zones of ISO 20816-3 are of {_lowest_hz(answers):g} Hz to "
        f"{ISO_BAND_HZ[1]:g} Hz. Have the device send {rounded_up(least_hz)} samples a second or more, best "
        f"{SAMPLES_PER_PERIOD * ISO_BAND_HZ[1]:g}, or the velocity RMS that it measures itself (type trend)."
    )


def sensor_questions(answers: Answers) -> Iterator[Question]:
    """What is on each channel."""
    bus = bus_of(answers)
    for channel in bus.channels(answers):
        yield from bus.of_channel(answers, channel)
        yield from _of_channel(answers, channel)


def _of_channel(answers: Answers, channel: str) -> Iterator[Question]:
    bus = bus_of(answers)
    known = {kind: TYPES[kind] for kind in bus.sensor_types(answers)}
    kind, unit = bus.guess(answers, channel)
    quiet = bus_of(answers).simulated

    def ask(topic: str, read: Any, default: str, **more: Any) -> Question:
        words = SENSOR_TOPICS[topic]
        filled = q.Topic(
            words.text.format(channel=channel, unit=answers.get(sensor_key(channel, "unit"), "mm/s")),
            words.help.format(channel=channel, unit=answers.get(sensor_key(channel, "unit"), "mm/s")),
        )
        return Question(sensor_key(channel, topic), filled, read, default, quiet=quiet, **more)

    yield ask("type", q.one_of(known), kind, choices=known)
    chosen = answers[sensor_key(channel, "type")]
    if chosen == NONE:
        return
    taken = {one.name for one in sensors(answers)}
    yield ask("name", q.name, unused(sensor_name(channel, chosen, bus.stream_name(answers)), taken))
    if chosen in _UNITS:
        units = dict.fromkeys(_UNITS[chosen], "")
        yield ask("unit", q.one_of(units), unit if unit in units else next(iter(units)), choices=units)
    elif chosen == "trend":
        # Of mm/s limits of ISO 20816-3 are proposed: only a name that means a vibration has it.
        yield ask("unit", _unit, unit or _NO_UNIT)
    if chosen in {"proximity", "accelerometer", "velocity"}:
        yield from _of_waveform(answers, channel, ask)
    if chosen == "keyphasor":
        yield ask("threshold", q.number_in("V"), "-6")


def _unit(text: str) -> str:
    """A unit as machine files spell it, however it was typed: ``mm/sec`` is ``mm/s``."""
    written = q.line(text)
    known = None if is_of_peak(written) else unit_of(written)
    return written if known is None else known.name


def _of_waveform(answers: Answers, channel: str, ask: Any) -> Iterator[Question]:
    kind = answers[sensor_key(channel, "type")]
    unit = _FIXED_UNITS.get(kind) or answers[sensor_key(channel, "unit")]
    volts = bus_of(answers).in_volts(answers, channel)
    yield ask("sensitivity", q.number_or_none, f"{_SENSITIVITY[unit]:g}" if volts else NONE)
    if kind == "proximity":
        probes = [one for one in sensors(answers) if one.type == "proximity"]
        yield ask("angle", q.number_in("deg", "degrees", "°"), "0" if len(probes) % 2 else "90")
    if kind == "accelerometer" and _tells_bearings(answers):
        yield ask("bearing", _bearing, NONE)


def _tells_bearings(answers: Answers) -> bool:
    """Whether samples and speed are such that the bearings' detector can work."""
    block_s = answers["samples"] / answers["rate"] if "samples" in answers else math.inf
    return (
        answers["rate"] >= _BEARING_RATE_HZ
        and abs(answers["speed"]) >= _BEARING_RPM
        and block_s >= _BEARING_BLOCK_S
    )


def why_no_bearing(answers: Answers) -> str:
    """What is missing for a bearing to be watched, and what to do."""
    if _tells_bearings(answers):
        return "only an accelerometer watches a bearing"
    return (
        f"bearings need {_BEARING_RATE_HZ:g} samples a second or more, {_BEARING_RPM:g} rpm or more, and "
        f"blocks of {_BEARING_BLOCK_S:g} s or more"
    )


def _bearing(text: str) -> Any:
    """A designation, or a table of the geometry; None without a bearing."""
    from daqsvc.bearing.geometry import bearing_orders  # noqa: PLC0415 - only what a verb needs

    if text.lower() == NONE:
        return None
    if "," in text:
        figures = [q.number(part.strip()) for part in text.split(",")]
        if not 3 <= len(figures) <= 4 or figures[0] != int(figures[0]):
            raise ValueError(
                "give a whole number of balls, ball and pitch diameter in mm, and perhaps the contact angle "
                "in degrees: 9, 7.94, 39.04"
            )
        keys = ("ball_diameter_mm", "pitch_diameter_mm", "contact_deg")
        return {"balls": int(figures[0]), **dict(zip(keys, figures[1:], strict=False))}
    try:
        bearing_orders(q.line(text))
    except KeyError as error:
        problem = f"{error.args[0]}".partition(" Give ")[0]
        raise ValueError(f"{problem} Or give balls, ball and pitch diameter in mm: 9, 7.94, 39.04") from None
    return text.strip()


def limit_questions(answers: Answers) -> Iterator[Question]:
    """Which limits, and of what."""
    limited = [one for one in sensors(answers) if one.measure is not None]
    if not limited:
        return
    in_range = _ISO_RPM[0] <= abs(answers["speed"]) <= _ISO_RPM[1]
    choices = {"iso": "zones of ISO 20816-3", "own": "two figures of yours", NONE: "write them later"}
    topic, read = TOPICS["limits"], q.one_of(choices)
    if not in_range or not any(one.iso for one in limited):
        del choices["iso"]
        read = q.one_of(choices)
        slow = _too_slow(answers) if any(one.housing for one in limited) else ""
        if in_range and (reason := slow or _other_velocities(limited) or _no_rms_words(limited)):
            why = f"No zones of ISO 20816-3: {reason}"
            topic, read = q.Topic(f"{why}\n{topic.text}", f"{why} {topic.help}"), _without_zones(read, why)
    of_simulated = limited[0].simulated and limited[0].type == "proximity"
    default = "own" if of_simulated else "iso" if "iso" in choices else NONE
    yield Question("limits", topic, read, default, choices)
    if answers["limits"] == "iso" and any(one.iso == "housing" for one in limited):
        yield Question("class", TOPICS["class"], q.one_of(CLASSES), "2-rigid", CLASSES)
    if answers["limits"] == "own":
        unit = limited[0].measure[1] if limited[0].measure else ""
        names = ", ".join(one.name for one in _with_own_limits(limited))
        alert = _usual_alert(limited[0])
        what = f"{limited[0].measure[0].replace('_', ' ')} of {names} in {unit}" if limited[0].measure else ""
        for key, factor in (("alert", 1.0), ("danger", 1.5)):
            words = q.Topic(f"{TOPICS[key].text} ({what})", TOPICS[key].help)
            yield Question(
                key,
                words,
                q.number_in(unit) if unit else q.number,
                alert if factor == 1.0 else _higher(answers["alert"]),
            )


def _usual_alert(sensor: Sensor) -> str | None:
    """An alert limit to begin with; None where nothing is usual."""
    unit = sensor.measure[1] if sensor.measure else ""
    if sensor.type == "proximity":
        return (_SIMULATED_ALERTS if sensor.simulated else _SHAFT_ALERTS).get(unit)
    return "2.8" if unit == "mm/s" and sensor.iso else None


def _with_own_limits(there: Sequence[Sensor]) -> list[Sensor]:
    """The sensors that two figures can be for: of one quantity, and of a unit that states none the first."""
    limited = [one for one in there if one.measure is not None]
    if limited and limited[0].unit in {_NO_UNIT, "count"}:
        return limited[:1]
    return [one for one in limited if one.measure == limited[0].measure]


def _other_velocities(there: Sequence[Sensor]) -> str:
    """Which velocities have no zones, as they are in another unit; empty if none is."""
    levels = [one for one in there if one.type == "trend" and one.iso is None]
    units = {one.name: one.unit for one in levels if one.unit != "mm/s"}
    known = {name: unit_of(unit) for name, unit in units.items()}
    others = [name for name, unit in known.items() if unit is not None and unit.quantity == "velocity"]
    if not others:
        return ""
    first = units[others[0]]
    factor = None if is_of_peak(first) else factor_between(first, "mm/s")
    remedy = (
        "Have the device send its RMS"
        if factor is None
        else f"1 {first} is {factor:g} mm/s: write mm/s as its unit, and multiply its scale by that"
    )
    named = ", ".join(f"{name} ({units[name]})" for name in others)
    return (
        f"they are of a velocity RMS in mm/s, and {named} is not. {remedy}; or write a separate alarm for it."
    )


def _no_rms_words(there: Sequence[Sensor]) -> str:
    """Which values in mm/s have no zones, as they are hardly an RMS; empty if none is."""
    if not (left := [one for one in there if one.no_rms]):
        return ""
    shown = ", ".join(f"{one.name} ({one.unit})" for one in left)
    return (
        f"they are for its RMS, and by unit or name {shown} is another value. Write [[alarms]] with limits "
        f"of your own for it. If it is an RMS, give it a name with RMS: --sensor {left[0].channel}.name="
        f"{left[0].channel}-RMS."
    )


def limits_words(answers: Answers) -> list[str]:
    """What the limits are not for, and so has no alarm, and the unit that they are in, if it is another."""
    there = [one for one in sensors(answers) if one.measure is not None]
    if answers.get("limits") == "iso" and (why := _other_velocities(there)):
        return [f"The zones of ISO 20816-3 are not for every velocity: {why}"]
    with_limits = _with_own_limits(there)
    others = ", ".join(one.name for one in there if one not in with_limits)
    if answers.get("limits") != "own" and (why := _no_rms_words(there)):
        return [f"The zones of ISO 20816-3 are not for every velocity: {why}"]
    if answers.get("limits") != "own" or not with_limits:
        return []
    words, names, first = [], ", ".join(one.name for one in with_limits), with_limits[0]
    if first.measure is not None and first.measure[1] != first.unit:
        words.append(
            f"Alert and danger of {names} are of the {first.measure[0].replace('_', ' ')} in "
            f"{first.measure[1]}, and not in {first.unit}."
        )
    if others:
        words.append(f"Alert and danger are for {names}. No alarm watches {others} yet: write one for each.")
    return words


def _without_zones(read: Callable[[str], Any], why: str) -> Callable[[str], Any]:
    """As ``read``, but whoever wants the zones hears why there are none."""

    def other(text: str) -> Any:
        if text.lower() == "iso":
            raise ValueError(why)
        return read(text)

    return other


def _higher(alert: float) -> str:
    return f"{alert + max(0.5 * abs(alert), 1e-3):.6g}"


def sensor_tables(answers: Answers) -> Iterator[str]:
    """Lines of ``[[sensors]]``."""
    for sensor in sensors(answers):
        get = partial(lambda channel, topic: answers.get(sensor_key(channel, topic)), sensor.channel)
        yield "[[sensors]]"
        yield entry("name", sensor.name)
        yield entry("type", sensor.type)
        yield entry("stream", bus_of(answers).stream_name(answers))
        yield entry("channel", sensor.channel)
        yield entry("unit", sensor.unit)
        sensitivity = get("sensitivity")
        if sensitivity is not None:
            yield entry("sensitivity_mv_per_unit", sensitivity, "from the sensor's calibration sheet")
        elif sensor.type in SENSOR_PREFIX:
            yield "# no sensitivity_mv_per_unit: the samples are in this unit already"
        if sensor.type == "proximity":
            if sensitivity is not None:
                yield entry("zero_v", _ZERO_V, "gap voltage with the shaft centred: measure it")
                yield entry("gap_ok_v", _OK_V, "beyond, the probe counts as broken; see its manual")
            yield entry("angle_deg", get("angle"), "0 to the right, 90 upwards, anticlockwise")
        if sensor.type == "keyphasor":
            yield entry("threshold_v", get("threshold"), "half-way up a pulse: look at it on a scope")
            yield entry("hysteresis_v", 0.5)
            yield entry("edge", "rising", 'or "falling": the edge that marks angle zero')
        if sensor.type == "trend":
            yield from _ok_between(sensor, answers)
        yield ""


def _ok_between(sensor: Sensor, answers: Answers) -> Iterator[str]:
    """What the sensor can measure: by it a wrong type, order or scale is found, and a broken sensor."""
    # Only what somebody has stated: beyond it the alarms are suppressed, also those of a hot machine.
    stated = bus_of(answers).measuring_range(answers, sensor.channel)
    covered = stated is not None and _covers(stated, _limits_of(sensor, answers), sensor.unit)
    if stated is not None and not covered:
        unit = "" if sensor.unit == _NO_UNIT else f" {sensor.unit}"
        yield f"# The DBC file states {stated[0]:g} to {stated[1]:g}{unit}. It is no ok_between here: beyond"
        yield "# it the alarm would be suppressed, where the machine is at its worst."
    if stated is None or not covered:
        about = "from the sensor's data sheet: beyond, its alarms are suppressed"
        yield f"# ok_between = [LEAST, GREATEST]    # {about}"
    else:
        yield entry("ok_between", list(stated), "by the DBC file; beyond, its alarms are suppressed")


def _limits_of(sensor: Sensor, answers: Answers) -> tuple[float, float] | None:
    """Alert and danger of the value of a sensor; None where it has no alarm by them."""
    limits = answers.get("limits", NONE)
    if limits == "iso" and sensor.iso == "housing":
        _, alert, danger = _zones(answers, sensor)[1]
        return alert, danger
    if limits == "own" and sensor in _with_own_limits(sensors(answers)):
        return answers["alert"], answers["danger"]
    return None


def _covers(stated: tuple[float, float], limits: tuple[float, float] | None, unit: str) -> bool:
    """Whether values that call for an alarm lie within a range that a DBC file states.

    Many files state the range of a display, which ends a little above danger. A machine that is about to fail
    vibrates several times as much. So the range of a vibration must reach four times as far beyond danger as
    danger is beyond alert: for ISO 20816-3 to 2.5 times the danger limit. It must reach half as far beyond
    danger as danger is from 0, too, else ``daqsvc check`` warns. A temperature goes less far.
    """
    if limits is None:
        return True
    alert, danger = limits
    room = max(4.0 * (danger - alert), 0.5 * danger) if unit in TYPE_OF_UNIT else danger - alert
    return stated[0] < alert and danger + room < stated[1]


def pipeline_tables(answers: Answers) -> Iterator[str]:
    """Lines of ``[pipeline]`` and its detectors."""
    there = sensors(answers)
    rate_hz, speed_rpm = answers["rate"], abs(answers["speed"])
    waveforms = [one for one in there if one.type in SENSOR_PREFIX]
    keyphasor = next((one.name for one in there if one.type == "keyphasor"), None)
    per_revolution = 60.0 * rate_hz / speed_rpm
    housing = any(one.housing for one in there)
    band_hz = _band_hz(answers)
    window_s = max(0.5, 16.0 / rate_hz, 2.0 / band_hz[0] if housing and band_hz else 0.0)
    by_mark = keyphasor is not None and per_revolution >= _HARMONIC_SAMPLES and bool(waveforms)
    if by_mark and 120.0 / speed_rpm > window_s:
        by_mark = 120.0 / speed_rpm <= _LONGEST_WINDOW_S
        window_s = max(window_s, 120.0 / speed_rpm) if by_mark else window_s
    window_s = _up(window_s)
    yield "[pipeline]"
    yield entry("ring_s", max(30.0, 4.0 * window_s), "how much of the past stays in memory")
    yield ""
    yield "[pipeline.levels]"
    if any(one.type == "trend" for one in there):
        yield "# A trend value is averaged over window_s: 0.5 s, if it is not stated here."
    if waveforms:
        yield entry("window_s", window_s, "time over which RMS, peak and so on are measured")
    if housing and band_hz:
        early = f"; the standard goes to {ISO_BAND_HZ[1]:g} Hz, half the sampling rate does not"
        about = "of the velocity RMS" + (early if band_hz[1] < ISO_BAND_HZ[1] else "")
        yield entry("velocity_band_hz", list(band_hz), about)
    elif housing:
        yield "# no velocity_band_hz: samples are too slow for a velocity RMS with 1X of the shaft in it"
    if by_mark:
        yield entry("keyphasor", keyphasor, "the mark from which phases count")
        yield entry("measures", ["1x_amplitude", "1x_phase_lag"], "measured for trends, without an alarm")
    yield ""
    bearings = [one for one in there if one.bearing is not None]
    if bearings:
        yield from _bearing_table(bearings, keyphasor if per_revolution >= _PULSE_SAMPLES else None)


def _bearing_table(bearings: list[Sensor], keyphasor: str | None) -> Iterator[str]:
    yield "[pipeline.bearing]               # tells which part of a rolling bearing is damaged"
    if keyphasor is not None:
        yield entry("keyphasor", keyphasor, "the speed is measured")
    else:
        yield "# Without a keyphasor machine.speed_rpm must be within 1 % of the true speed."
    yield entry("calibrate_s", 30.0, "the first seconds are the healthy machine; kept over restarts")
    tables = []
    for one in bearings:
        key = "type" if isinstance(one.bearing, str) else "geometry"
        tables.append({"name": one.name, "sensor": one.name, key: one.bearing})
    yield from array("bearings", tables)
    yield ""


def _up(seconds: float) -> float:
    """Rounded up to a tenth of a second."""
    return math.ceil(round(10.0 * seconds, 6)) / 10.0


def alarm_tables(answers: Answers) -> Iterator[str]:
    """Lines of ``[[alarms]]``; what has no limits yet has them in a comment."""
    there = sensors(answers)
    limits = answers.get("limits", NONE)
    own = _with_own_limits(there)
    for sensor in there:
        if sensor.measure is None:
            continue
        if limits == "iso" and sensor.iso is not None:
            yield from _iso_alarm(answers, sensor)
        elif limits == "own" and sensor in own:
            yield from _own_alarm(answers, sensor)
        else:
            yield from _later(sensor)
        yield ""
    if any(one.bearing is not None for one in there):
        yield "[[alarms]]"
        yield entry("name", unused("bearing-damage", {one.name for one in there}))
        yield entry("detector", "bearing", "level and cause are what it finds")
        yield entry("latching", value=True, comment="damage does not heal: it stays until it is reset")
        yield ""


def _zones(answers: Answers, sensor: Sensor) -> tuple[dict[str, Any], Boundaries]:
    """The zones of a sensor as a table, and where B, C and D begin."""
    from daqsvc.settings.zones import Zones, boundaries  # noqa: PLC0415 - brings the settings

    table: dict[str, Any] = {"standard": "iso-20816-3"}
    if sensor.iso == "shaft":
        table["shaft"] = True
    else:
        group, support = answers["class"].split("-")
        table |= {"group": int(group), "support": support}
    at: Boundaries | None = boundaries(
        Zones(**table), answers["speed"], sensor.unit if sensor.iso == "shaft" else "mm/s"
    )
    assert at is not None  # noqa: S101 - for the type checker: the table is complete
    return table, at


def _iso_alarm(answers: Answers, sensor: Sensor) -> Iterator[str]:
    table, at = _zones(answers, sensor)
    measure, unit = sensor.measure or ("", "")
    if sensor.iso == "shaft":
        measure = "peak_to_peak"
    yield f"# Alert where zone C begins, {at[1]:g} {unit}, danger where zone D does, {at[2]:g} {unit}."
    yield from _alarm(sensor.name, measure, {"zones": table}, at[1])


def _own_alarm(answers: Answers, sensor: Sensor) -> Iterator[str]:
    measure, unit = sensor.measure or ("", "")
    yield f"# Setpoints in {unit}: best from the machine itself, when it is in good order."
    limits = {"alert": answers["alert"], "danger": answers["danger"]}
    yield from _alarm(sensor.name, measure, limits, answers["alert"])


def _alarm(name: str, measure: str, limits: dict[str, Any], alert: float) -> Iterator[str]:
    yield "[[alarms]]"
    yield entry("name", name)
    yield entry("sensor", name)
    yield entry("measure", measure)
    for key, value in limits.items():
        yield entry(key, value)
    yield entry("deadband", float(f"{0.05 * abs(alert):.2g}"), "returns this far below a limit")
    yield entry("on_delay_s", 3.0, "time at a limit before it counts")
    yield entry("off_delay_s", 5.0, "time below a limit before it returns")
    yield entry("latching", value=False, comment="true: it stays until somebody resets it")


def _later(sensor: Sensor) -> Iterator[str]:
    measure, unit = sensor.measure or ("", "")
    begin = "Take them" if unit == _NO_UNIT else f"In {unit}; take them"
    yield f"# No limits yet. {begin} from the machine in good order, or ask its maker:"
    yield "# [[alarms]]"
    for key, value in (("name", sensor.name), ("sensor", sensor.name), ("measure", measure)):
        yield f"# {key} = {toml(value)}"
    yield "# alert = ..."
    yield behind(
        "# danger = ...",
        "and alert_low, danger_low of a value that can be too low" if sensor.type == "trend" else "",
    )
