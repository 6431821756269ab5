"""Calibrations on disk: a TOML file that a person can read, and that comes back to the last bit.

`load_calibration` reads the healthy machine at one speed, `load_healthy` as far as the file knows it, and
`load_record` everything that a file holds.
"""

from __future__ import annotations

import math
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.confined.small_toml import TomlFileError, parse_toml, read_toml
from daqsvc.rotor.calibration.run_up import RunUpFit
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.synchronous.baseline import SPEED_TOLERANCE, Calibration

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRecord:
    """What is known about a healthy machine.

    Attributes:
        rotor: the rotor, as it was given or as the run-up shows it.
        steady: baselines, one for each speed.
        steady_sources: the recording that each baseline comes from.
        run_up: what a run-up showed, if there was one.
        run_up_source: the recording of it.
        written: label of the date, ISO 8601; empty if not known.
    """

    rotor: LavalRotor
    steady: tuple[Calibration, ...] = ()
    steady_sources: tuple[str, ...] = ()
    run_up: RunUpFit | None = None
    run_up_source: str = ""
    written: str = ""

    def at(self, speed_rpm: float | None = None) -> Calibration:
        """The baseline of a speed.

        Args:
            speed_rpm: shaft speed of either sign; may be left out if there is one baseline only.

        Raises:
            ValueError: there is none of that speed, or several and no speed was given.
        """
        if not self.steady:
            raise ValueError(
                "the calibration holds a run-up only and no steady baseline; calibrate again with a "
                "recording at the speed that is watched"
            )
        if speed_rpm is not None:
            return baseline_at(self.steady, speed_rpm)
        if len(self.steady) > 1:
            raise ValueError(
                f"the calibration holds baselines at {_speeds(self.steady)} rpm; say at which speed"
            )
        return self.steady[0]


def baseline_at(baselines: Sequence[Calibration], speed_rpm: float) -> Calibration:
    """The baseline that holds at a speed.

    Args:
        baselines: one or more.
        speed_rpm: shaft speed of either sign.

    Raises:
        ValueError: there is none within `SPEED_TOLERANCE` of it.
    """
    nearest = min(baselines, key=lambda one: abs(one.speed_rpm - abs(speed_rpm)))
    if abs(abs(speed_rpm) / nearest.speed_rpm - 1.0) > SPEED_TOLERANCE:
        raise ValueError(
            f"the calibration holds no baseline within {100.0 * SPEED_TOLERANCE:.0f} % of "
            f"{abs(speed_rpm):.1f} rpm, but at {_speeds(baselines)} rpm; calibrate at that speed"
        )
    return nearest


def _speeds(baselines: Sequence[Calibration]) -> str:
    return ", ".join(f"{baseline.speed_rpm:.1f}" for baseline in baselines)


__all__ = [
    "SCHEMA_VERSION",
    "CalibrationFileError",
    "CalibrationRecord",
    "load_calibration",
    "load_healthy",
    "load_record",
    "parse_record",
    "record_text",
    "save_calibration",
    "save_record",
]

SCHEMA_VERSION = 1

_REMEDY = "name a file that daqsvc calibrate wrote, or calibrate again"

_COMPONENTS = (
    "mean_position_um",
    "forward_1x_um",
    "backward_1x_um",
    "forward_2x_um",
    "backward_2x_um",
)
"""Keys of the components of a baseline, in the order of `synchronous.HARMONICS`."""
_PREAMBLE = """\
# The healthy machine, as `daqsvc calibrate` saw it. Lengths in um, angles in degrees from the keyphasor's
# mark in the direction of rotation (x is mirrored if the shaft turns clockwise). +- is a standard deviation.
"""


def load_calibration(path: Path | str, speed_rpm: float | None = None) -> Calibration:
    """The healthy machine at one speed.

    Args:
        path: the file.
        speed_rpm: see `CalibrationRecord.at`.

    Raises:
        CalibrationFileError: the file cannot be read or used, or has no baseline of that speed.
    """
    record = load_record(path)
    try:
        return record.at(speed_rpm)
    except ValueError as error:
        raise CalibrationFileError(f"{path}: {error}") from None


def load_healthy(
    path: Path | str, speed_rpm: float | None, clearance_um: float | None = None
) -> tuple[LavalRotor, tuple[Calibration, ...]]:
    """What a file says about the healthy machine, at one speed or at any.

    Args:
        path: the file.
        speed_rpm: shaft speed of either sign; None where it is not known yet.
        clearance_um: radial clearance, in place of the file's.

    Returns:
        The rotor, and the baseline of the speed, or of every speed if it is not known. None at all if the
        file holds a run-up, which is true at any speed, and no baseline of that one: the first revolutions
        have to be the baseline then.

    Raises:
        CalibrationFileError: the file cannot be read or used, or has neither a run-up nor a baseline of that
            speed.
    """
    record = load_record(path)
    rotor, baselines = record.rotor, record.steady
    if baselines and speed_rpm is not None:
        try:
            baselines = (record.at(speed_rpm),)
        except ValueError as error:
            if record.run_up is None:
                raise CalibrationFileError(f"{path}: {error}") from None
            baselines = ()
    if clearance_um is not None:
        rotor = replace(rotor, clearance_um=clearance_um)
        baselines = tuple(replace(baseline, rotor=rotor) for baseline in baselines)
    return rotor, baselines


def load_record(path: Path | str) -> CalibrationRecord:
    """Everything that a file holds.

    Raises:
        CalibrationFileError: it cannot be read or used; the message names file, key, value and remedy.
    """
    path = Path(path)
    try:
        document = read_toml(path)
    except OSError as error:
        raise CalibrationFileError(
            f"{path}: {error.strerror}; name a file that daqsvc calibrate wrote"
        ) from None
    except TomlFileError as error:
        raise CalibrationFileError(f"{path}: {error}; {_REMEDY}") from None
    return _record(document, path)


def save_calibration(calibration: Calibration, path: Path | str, *, source: str = "") -> None:
    """Write the healthy machine at one speed; see `save_record`."""
    record = CalibrationRecord(rotor=calibration.rotor, steady=(calibration,), steady_sources=(source,))
    save_record(record, path)


def save_record(record: CalibrationRecord, path: Path | str) -> None:
    """Write everything; a file of that name is replaced as a whole, or not at all.

    Raises:
        CalibrationFileError: the file cannot be written.
    """
    path = Path(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    text = record_text(record)
    try:
        try:
            beside.write_text(text, encoding="utf-8")
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise CalibrationFileError(
            f"{path}: cannot be written: {error.strerror}; name a file in a directory that can be"
        ) from None


def record_text(record: CalibrationRecord) -> str:
    """A record as TOML.

    Raises:
        ValueError: a baseline was made with another rotor than the record's.
    """
    return "\n".join(_lines(record)) + "\n"


def _lines(record: CalibrationRecord) -> Iterator[str]:
    yield _PREAMBLE + f"schema_version = {SCHEMA_VERSION}"
    if record.written:
        yield f"written = {_quoted(record.written)}"
    rotor = record.rotor
    yield "\n[rotor]"
    yield f"natural_frequency_hz = {rotor.natural_frequency_hz!r}"
    yield f"natural_frequency_tolerance = {rotor.natural_frequency_tolerance!r}  # relative"
    yield f"damping_ratio = {rotor.damping_ratio!r}"
    yield f"damping_tolerance = {rotor.damping_tolerance!r}  # relative"
    if rotor.clearance_um is not None:
        yield f"clearance_um = {rotor.clearance_um!r}"
    if rotor.static_sag_um is not None:
        yield f"static_sag_um = {rotor.static_sag_um!r}"
    if record.run_up is not None:
        yield from _run_up_lines(record.run_up, record.run_up_source)
    for calibration, source in zip(record.steady, record.steady_sources, strict=True):
        if calibration.rotor != rotor:
            raise ValueError(
                f"the baseline at {calibration.speed_rpm:.1f} rpm was made with {calibration.rotor}, the "
                f"record has {rotor}; make all baselines of a record with one rotor"
            )
        yield from _steady_lines(calibration, source)


def _run_up_lines(fit: RunUpFit, source: str) -> Iterator[str]:
    low, high = fit.speed_range_rpm
    yield "\n[run_up]"
    yield f"verdict = {_quoted(fit.describe())}"
    yield f"source = {_quoted(source)}"
    yield f"revolutions = {fit.revolutions}"
    yield f"speed_range_rpm = [{low!r}, {high!r}]"
    yield f"natural_frequency_hz = {_with(fit.natural_frequency_hz, fit.natural_frequency_uncertainty_hz)}"
    yield f"damping_ratio = {_with(fit.damping_ratio, fit.damping_uncertainty)}"
    yield (
        f"eccentricity_um = {_complex(fit.eccentricity_um)}  # {_polar(fit.eccentricity_um)}, "
        f"+- {fit.eccentricity_uncertainty_um:.2g} um, {fit.heavy_spot_uncertainty_deg:.2g} degrees"
    )
    yield f"centre_um = {_complex(fit.centre_um)}  # +- {fit.centre_uncertainty_um:.2g} each"
    yield f"centre_uncertainty_um = {fit.centre_uncertainty_um!r}"
    yield f"ellipticity = {fit.ellipticity!r}  # backward over forward whirl"
    yield f"noise_um = {fit.noise_um!r}  # standard deviation of a sample of one probe"
    yield f"fit_error = {fit.fit_error!r}  # of the whirl, not explained by a Laval rotor"
    rows = ",\n    ".join(f"[{', '.join(repr(float(value)) for value in row)}]" for row in fit.covariance)
    yield "# of ln natural_frequency_hz, ln damping_ratio, real and imaginary part of ln eccentricity"
    yield f"covariance = [\n    {rows},\n]"


def _steady_lines(calibration: Calibration, source: str) -> Iterator[str]:
    yield "\n[[steady]]"
    yield f"verdict = {_quoted(calibration.describe())}"
    yield f"source = {_quoted(source)}"
    yield f"speed_rpm = {calibration.speed_rpm!r}"
    yield f"revolutions = {calibration.revolutions}"
    yield f"samples_per_rev = {calibration.samples_per_rev!r}"
    yield (
        f"noise_variance_um2 = {calibration.noise!r}  # {calibration.noise_um:.3g} um rms of a sample of one "
        f"probe, SNR {calibration.snr_db:.1f} dB"
    )
    yield f"noise_relative_variance = {calibration.noise_variance!r}  # from revolution to revolution"
    if calibration.fit_error is not None:
        yield f"fit_error = {calibration.fit_error!r}  # of the run-up"
    eccentricity = calibration.eccentricity_um
    yield f"# unbalance, if this is a Laval rotor: eccentricity {_polar(eccentricity)}"
    for key, value, variance in zip(
        _COMPONENTS, calibration.baseline.tolist(), calibration.variance.tolist(), strict=True
    ):
        deviation = math.sqrt(variance / calibration.revolutions / 2.0)
        yield (
            f"{key} = {{ re = {value.real!r}, im = {value.imag!r}, revolution_variance = {variance!r} }}"
            f"  # {_polar(value)}, +- {deviation:.2g} each"
        )


def parse_record(text: str, path: Path) -> CalibrationRecord:
    """A record from its text.

    Args:
        text: TOML.
        path: the file that messages name.

    Raises:
        CalibrationFileError: the text cannot be used.
    """
    try:
        document = parse_toml(text)
    except TomlFileError as error:
        raise CalibrationFileError(f"{path}: {error}; {_REMEDY}") from None
    return _record(document, path)


def _record(document: Mapping[str, Any], path: Path) -> CalibrationRecord:
    if document.get("kind") == "bearing":
        raise CalibrationFileError(
            f"{path}: was written of bearings, for pipeline.bearing.calibration or for --calibration with "
            f"--bearing or --orders, and a rotor is watched here; {_REMEDY}"
        )
    table = Table(document, path)
    version = table.whole("schema_version")
    if version != SCHEMA_VERSION:
        raise table.wrong(
            "schema_version",
            version,
            f"this program reads version {SCHEMA_VERSION}; calibrate again with it",
        )
    written = table.text("written", default="")
    rotor = _rotor(table.table("rotor"))
    run_up, run_up_source = None, ""
    if (run_up_table := table.optional_table("run_up")) is not None:
        run_up_source = run_up_table.text("source", default="")
        run_up = _run_up(run_up_table)
    steady, sources = [], []
    for part in table.tables("steady"):
        sources.append(part.text("source", default=""))
        steady.append(_steady(part, rotor))
    if run_up is None and not steady:
        raise CalibrationFileError(f"{path}: neither [run_up] nor [[steady]] is there; calibrate again")
    table.nothing_else()
    return CalibrationRecord(
        rotor=rotor,
        steady=tuple(steady),
        steady_sources=tuple(sources),
        run_up=run_up,
        run_up_source=run_up_source,
        written=written,
    )


def _rotor(table: Table) -> LavalRotor:
    rotor = LavalRotor(
        natural_frequency_hz=table.number("natural_frequency_hz", above=0.0),
        damping_ratio=table.number("damping_ratio", above=0.0, below=1.0),
        natural_frequency_tolerance=table.number("natural_frequency_tolerance", least=0.0, below=1.0),
        damping_tolerance=table.number("damping_tolerance", least=0.0, below=1.0),
        clearance_um=table.optional_number("clearance_um", above=0.0),
        static_sag_um=table.optional_number("static_sag_um"),
    )
    table.nothing_else()
    return rotor


def _run_up(table: Table) -> RunUpFit:
    table.text("verdict", default="")
    low, high = table.numbers("speed_range_rpm", 2)
    if not 0.0 < low < high:
        raise table.wrong("speed_range_rpm", [low, high], "give the lowest and the highest speed")
    covariance = table.matrix("covariance", 4)
    if np.any(np.diag(covariance) < 0.0):
        raise table.wrong("covariance", np.diag(covariance).tolist(), "no variance can be below 0")
    fit = RunUpFit(
        natural_frequency_hz=table.number("natural_frequency_hz", above=0.0),
        damping_ratio=table.number("damping_ratio", above=0.0, below=1.0),
        eccentricity_um=table.complex_number("eccentricity_um"),
        centre_um=table.complex_number("centre_um"),
        covariance=covariance,
        centre_uncertainty_um=table.number("centre_uncertainty_um", least=0.0),
        ellipticity=table.number("ellipticity", least=0.0),
        noise_um=table.number("noise_um", least=0.0),
        fit_error=table.number("fit_error", least=0.0),
        speed_range_rpm=(low, high),
        revolutions=table.whole("revolutions", least=1),
    )
    table.nothing_else()
    return fit


def _steady(table: Table, rotor: LavalRotor) -> Calibration:
    table.text("verdict", default="")
    baseline, variance = [], []
    for key in _COMPONENTS:
        part = table.table(key)
        baseline.append(complex(part.number("re"), part.number("im")))
        variance.append(part.number("revolution_variance", above=0.0))
        part.nothing_else()
    calibration = Calibration(
        rotor=rotor,
        speed_rpm=table.number("speed_rpm", above=0.0),
        revolutions=table.whole("revolutions", least=1),
        baseline=np.array(baseline, dtype=np.complex128),
        variance=np.array(variance, dtype=np.float64),
        noise=table.number("noise_variance_um2", above=0.0),
        noise_variance=table.number("noise_relative_variance", above=0.0),
        samples_per_rev=table.number("samples_per_rev", above=0.0),
        fit_error=table.optional_number("fit_error", least=0.0),
    )
    table.nothing_else()
    return calibration


def _with(value: float, deviation: float) -> str:
    return f"{value!r}  # +- {deviation:.2g}"


def _complex(value: complex) -> str:
    return f"{{ re = {value.real!r}, im = {value.imag!r} }}"


def _polar(value: complex) -> str:
    return f"{abs(value):.4g} um at {math.degrees(math.atan2(value.imag, value.real)):z.1f} degrees"


def _quoted(text: str) -> str:
    """A TOML basic string."""
    escaped: list[Any] = []
    for letter in text:
        if letter in '"\\':
            escaped.append(f"\\{letter}")
        elif ord(letter) < 0x20 or ord(letter) == 0x7F:
            escaped.append(f"\\u{ord(letter):04x}")
        elif 0xD800 <= ord(letter) <= 0xDFFF:
            escaped.append("\ufffd")  # bytes of a file name that are no text
        else:
            escaped.append(letter)
    return f'"{"".join(escaped)}"'


_RESTORE = "restore the file, or calibrate again"


class CalibrationFileError(ValueError):
    """A calibration file cannot be read, used or written; the message says why and what to do."""


class Table:
    """A table of a calibration file.

    Args:
        values: what it holds.
        path: the file.
        name: keys that lead to it.
    """

    def __init__(self, values: Mapping[str, Any], path: Path, name: str = "") -> None:
        self._values = values
        self._path = path
        self._name = name
        self._read: set[str] = set()

    def wrong(self, key: str, value: object, remedy: str) -> CalibrationFileError:
        """The error about a value."""
        return CalibrationFileError(f"{self._path}: {self._place(key)} = {value!r}: {remedy}")

    def number(
        self,
        key: str,
        *,
        above: float = -math.inf,
        least: float = -math.inf,
        below: float = math.inf,
    ) -> float:
        """A finite number.

        Raises:
            CalibrationFileError: it is not there, no number, or outside of its bounds.
        """
        value = self._number(key, self._get(key))
        if not (value > above and value >= least and value < below):
            bounds = [
                f"{word} {bound:g}"
                for word, bound in (("above", above), ("at least", least), ("below", below))
                if math.isfinite(bound)
            ]
            raise self.wrong(key, value, f"it must be {' and '.join(bounds)}; {_RESTORE}")
        return value

    def optional_number(self, key: str, **bounds: float) -> float | None:
        """The same, or None if it is not there."""
        return self.number(key, **bounds) if key in self._values else None

    def numbers(self, key: str, count: int) -> list[float]:
        """So many finite numbers."""
        value = self._get(key)
        if not isinstance(value, list) or len(value) != count:
            raise self.wrong(key, value, f"it must be {count} numbers; {_RESTORE}")
        return [self._number(key, part) for part in value]

    def matrix(self, key: str, size: int) -> NDArray[np.float64]:
        """A square of finite numbers."""
        value = self._get(key)
        if not isinstance(value, list) or len(value) != size:
            raise self.wrong(key, value, f"it must be {size} rows of {size} numbers; {_RESTORE}")
        rows = [Table({key: row}, self._path, self._name).numbers(key, size) for row in value]
        return np.array(rows, dtype=np.float64)

    def complex_number(self, key: str) -> complex:
        """A table of ``re`` and ``im``."""
        part = self.table(key)
        value = complex(part.number("re"), part.number("im"))
        part.nothing_else()
        return value

    def whole(self, key: str, *, least: int = 0) -> int:
        """A whole number."""
        value = self._get(key)
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise self.wrong(key, value, f"it must be a whole number from {least} on; {_RESTORE}")
        return value

    def text(self, key: str, *, default: str) -> str:
        """A text, or the default if it is not there."""
        self._read.add(key)
        value = self._values.get(key, default)
        if not isinstance(value, str):
            raise self.wrong(key, value, f"it must be a text in quotes; {_RESTORE}")
        return value

    def table(self, key: str) -> Table:
        """A table inside."""
        value = self._get(key)
        if not isinstance(value, dict):
            raise self.wrong(key, value, f"it must be a table; {_RESTORE}")
        return Table(value, self._path, self._place(key))

    def optional_table(self, key: str) -> Table | None:
        """The same, or None if it is not there."""
        return self.table(key) if key in self._values else None

    def tables(self, key: str) -> list[Table]:
        """Tables in a row, none if the key is not there."""
        self._read.add(key)
        value = self._values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(part, dict) for part in value):
            raise self.wrong(key, value, f"it must be [[{key}]] tables; {_RESTORE}")
        return [Table(part, self._path, f"{self._place(key)}[{i}]") for i, part in enumerate(value)]

    def nothing_else(self) -> None:
        """Refuse keys that nobody has read.

        Raises:
            CalibrationFileError: there is one.
        """
        for key, value in self._values.items():
            if key not in self._read:
                raise self.wrong(key, value, "there is no such key; remove it, or calibrate again")

    def _get(self, key: str) -> Any:
        self._read.add(key)
        if key not in self._values:
            raise CalibrationFileError(f"{self._path}: {self._place(key)} is missing; {_RESTORE}")
        return self._values[key]

    def _number(self, key: str, value: object) -> float:
        number = math.nan
        if isinstance(value, int | float) and not isinstance(value, bool):
            # A whole number may be too large for a float.
            number = float(value) if abs(value) <= sys.float_info.max else math.inf
        if not math.isfinite(number):
            raise self.wrong(key, value, f"it must be a finite number; {_RESTORE}")
        return number

    def _place(self, key: str) -> str:
        return f"{self._name}.{key}" if self._name else key
