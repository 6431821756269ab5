"""Calibrations on disk: a TOML file that a person can read, and that comes back to the last bit.

`load_calibration` reads the healthy machine at one speed, `load_healthy` as far as the file knows it, and
`load_record` everything that a file holds.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, ValidationError
from pydantic_core import PydanticCustomError

from daqsvc.confined.small_toml import TomlFileError, parse_toml, read_toml
from daqsvc.errors.detectors import CALIBRATION_FILE
from daqsvc.rotor.calibration.run_up import RunUpFit
from daqsvc.rotor.calibration.two_modes import TwoModeFit
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.model import TwoModes
from daqsvc.rotor.synchronous.baseline import SPEED_TOLERANCE, Calibration, with_rotor
from daqsvc.rotor.synchronous.speed_law import SpeedLaw

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pydantic_core import ErrorDetails


_ROUNDED = 1e-6
"""Part of a covariance that arithmetic leaves."""


class CalibrationFileError(ValueError):
    """A calibration file cannot be read, used or written; the message states why and what to do."""

    code = CALIBRATION_FILE


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRecord:
    """What is known about a healthy machine.

    Attributes:
        rotor: the rotor, as it was given or as the run-up shows it.
        steady: baselines, one for each speed.
        steady_sources: the recording that each baseline comes from.
        run_up: what a run-up showed, if there was one.
        run_up_source: the recording of it.
        two_modes: the same run-up as a rotor with two modes, for a rotor bank.
        written: label of the date, ISO 8601; empty if not known.
    """

    rotor: LavalRotor
    steady: tuple[Calibration, ...] = ()
    steady_sources: tuple[str, ...] = ()
    run_up: RunUpFit | None = None
    run_up_source: str = ""
    two_modes: TwoModeFit | None = None
    written: str = ""

    def with_modes(self, rotor: LavalRotor, speed_rpm: float | None) -> LavalRotor:
        """What is known of a rotor, and its two modes if they explain the run-up and that passed the speed.

        Args:
            rotor: the Laval rotor that is nearest to it.
            speed_rpm: shaft speed of either sign; None if it is not known.
        """
        modes = self.two_modes
        if modes is None or not (speed_rpm is None or modes.holds_at(speed_rpm)):
            return rotor
        return modes.beside(rotor)

    def as_watched(self, calibration: Calibration) -> Calibration:
        """A baseline with what the run-up shows of the rotor, as whoever watches by the file has it."""
        return with_rotor(calibration, self.with_modes(calibration.rotor, calibration.speed_rpm))

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
            raise ValueError(f"the calibration holds baselines at {_speeds(self.steady)} rpm; give the speed")
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


_RESTORE = "restore the file, or calibrate again"
_MISTAKES = {
    "extra_forbidden": "there is no such key; remove it, or calibrate again",
    "finite_number": f"it must be a finite number; {_RESTORE}",
    "float_type": f"it must be a finite number; {_RESTORE}",
    "model_type": f"it must be a table; {_RESTORE}",
    "string_type": f"it must be a text in quotes; {_RESTORE}",
}


def _refused(value: object, why: str) -> PydanticCustomError:
    return PydanticCustomError("refused", "{why}", {"why": why, "value": value})


def _number(
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    below: float = math.inf,
    most: float = math.inf,
) -> AfterValidator:
    """A number within bounds."""
    bounds = (("above", above), ("at least", least), ("below", below), ("at most", most))
    wanted = " and ".join(f"{word} {bound:g}" for word, bound in bounds if math.isfinite(bound))

    def check(value: float) -> float:
        if not (value > above and value >= least and value < below and value <= most):
            raise _refused(value, f"it must be {wanted}; {_RESTORE}")
        return value

    return AfterValidator(check)


def _whole(least: int) -> BeforeValidator:
    """A whole number."""

    def check(value: object) -> object:
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise _refused(value, f"it must be a whole number from {least} on; {_RESTORE}")
        return value

    return BeforeValidator(check)


def _list(wanted: str, length: int | None = None, of: type = object) -> BeforeValidator:
    """A list of that length, of any length if there is none."""

    def check(value: object) -> object:
        if (
            not isinstance(value, list)
            or (length is not None and len(value) != length)
            or not all(isinstance(part, of) for part in value)
        ):
            raise _refused(value, f"it must be {wanted}; {_RESTORE}")
        return value

    return BeforeValidator(check)


def _this_version(version: int) -> int:
    if version != SCHEMA_VERSION:
        raise _refused(version, f"this program reads version {SCHEMA_VERSION}; calibrate again with it")
    return version


def _rising(speeds: list[float]) -> list[float]:
    if not 0.0 < speeds[0] < speeds[1]:
        raise _refused(speeds, "give the lowest and the highest speed")
    return speeds


def _variances(covariance: list[list[float]]) -> list[list[float]]:
    rows = np.array(covariance)
    size = np.sqrt(np.maximum(np.abs(np.diag(rows)), np.finfo(float).tiny))
    scaled = rows / np.outer(size, size)
    if np.abs(scaled - scaled.T).max() > _ROUNDED:
        raise _refused(covariance, "give the same numbers in rows and columns")
    if np.linalg.eigvalsh(scaled).min() < -_ROUNDED:
        raise _refused(covariance, "no variance can be below 0, in any direction")
    return covariance


Positive = Annotated[float, _number(above=0.0)]
NotNegative = Annotated[float, _number(least=0.0)]
Tolerance = Annotated[float, _number(least=0.0, below=1.0)]
Share = Annotated[float, _number(above=0.0, most=1.0)]
DampingRatio = Annotated[float, _number(above=0.0, below=1.0)]
Count = Annotated[int, _whole(1)]
_Row = Annotated[list[float], _list("4 numbers", 4)]


class _CalibrationTable(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class _RotorTable(_CalibrationTable):
    natural_frequency_hz: Positive
    damping_ratio: DampingRatio
    natural_frequency_tolerance: Tolerance
    damping_tolerance: Tolerance
    clearance_um: Positive | None = None
    static_sag_um: float | None = None


class _ComplexTable(_CalibrationTable):
    re: float
    im: float

    def made(self) -> complex:
        return complex(self.re, self.im)


class _RunUpTable(_CalibrationTable):
    verdict: str = ""
    source: str = ""
    speed_range_rpm: Annotated[list[float], _list("2 numbers", 2), AfterValidator(_rising)]
    covariance: Annotated[list[_Row], _list("4 rows of 4 numbers", 4), AfterValidator(_variances)]
    natural_frequency_hz: Positive
    damping_ratio: DampingRatio
    eccentricity_um: _ComplexTable
    centre_um: _ComplexTable
    centre_uncertainty_um: NotNegative
    ellipticity: NotNegative
    noise_um: NotNegative
    fit_error: NotNegative
    revolutions: Count

    def made(self) -> RunUpFit:
        low, high = self.speed_range_rpm
        figures = self.model_dump(exclude={"verdict", "source"}) | {
            "speed_range_rpm": (low, high),
            "covariance": np.array(self.covariance, dtype=np.float64),
            "eccentricity_um": self.eccentricity_um.made(),
            "centre_um": self.centre_um.made(),
        }
        return RunUpFit(**figures)


class _TwoModesTable(_CalibrationTable):
    verdict: str = ""
    natural_frequency_hz: Positive
    damping_ratio: Positive
    eccentricity_um: _ComplexTable
    support_share: Share
    support_lag: Positive
    cross_stiffness: float
    anisotropy: _ComplexTable
    damping_anisotropy: _ComplexTable
    gyroscopic: float
    higher_modes: _ComplexTable
    runout_forward_um: _ComplexTable
    runout_backward_um: _ComplexTable
    fit_error: NotNegative

    def made(self, speed_range_rpm: tuple[float, float]) -> TwoModeFit:
        return TwoModeFit(
            natural_frequency_hz=self.natural_frequency_hz,
            damping_ratio=self.damping_ratio,
            eccentricity_um=self.eccentricity_um.made(),
            modes=TwoModes(
                support_share=self.support_share,
                support_lag=self.support_lag,
                cross_stiffness=self.cross_stiffness,
                anisotropy=self.anisotropy.made(),
                damping_anisotropy=self.damping_anisotropy.made(),
                gyroscopic=self.gyroscopic,
                higher_modes=self.higher_modes.made(),
                runout_um=(self.runout_forward_um.made(), self.runout_backward_um.made()),
            ),
            fit_error=self.fit_error,
            speed_range_rpm=speed_range_rpm,
        )


class _ComponentTable(_ComplexTable):
    revolution_variance: Positive


_Five = Annotated[list[float], _list("5 numbers", 5)]
_FiveSizes = Annotated[list[NotNegative], _list("5 numbers", 5)]
_Covariance = Annotated[
    list[Annotated[list[float], _list("3 numbers", 3)]], _list("3 rows", 3), AfterValidator(_variances)
]


class _SpeedLawTable(_CalibrationTable):
    slope_re_um: _Five
    slope_im_um: _Five
    rate_re_um: _Five = [0.0] * 5
    rate_im_um: _Five = [0.0] * 5
    covariance_um2: Annotated[list[_Covariance], _list("5 tables", 5)] | None = None
    off_um: _FiveSizes = [0.0] * 5
    # Of files of earlier versions, in place of covariance and what is off:
    slope_uncertainty_um: _FiveSizes = [0.0] * 5
    bend_um: _FiveSizes = [0.0] * 5
    late_um: _FiveSizes = [0.0] * 5

    def made(self) -> SpeedLaw:
        rows = (self.slope_re_um, self.slope_im_um), (self.rate_re_um, self.rate_im_um)
        if self.covariance_um2 is not None:
            covariance = np.array(self.covariance_um2)
        else:
            covariance = np.zeros((5, 3, 3))
            covariance[:, 0, 0] = np.square(self.slope_uncertainty_um)
        return SpeedLaw(
            follows_um=np.array([np.array(re) + 1j * np.array(im) for re, im in rows]),
            covariance_um2=covariance,
            off_um=np.sqrt(np.sum(np.square([self.off_um, self.bend_um, self.late_um]), axis=0)),
        )


class _SteadyTable(_CalibrationTable):
    verdict: str = ""
    source: str = ""
    mean_position_um: _ComponentTable
    forward_1x_um: _ComponentTable
    backward_1x_um: _ComponentTable
    forward_2x_um: _ComponentTable
    backward_2x_um: _ComponentTable
    speed_rpm: Positive
    revolutions: Count
    noise_variance_um2: Positive
    noise_relative_variance: Positive
    samples_per_rev: Positive
    fit_error: NotNegative | None = None
    speed_law: _SpeedLawTable | None = None

    def made(self, rotor: LavalRotor) -> Calibration:
        components: list[_ComponentTable] = [getattr(self, key) for key in _COMPONENTS]
        return Calibration(
            rotor=rotor,
            speed_rpm=self.speed_rpm,
            revolutions=self.revolutions,
            baseline=np.array([component.made() for component in components]),
            variance=np.array([component.revolution_variance for component in components]),
            noise=self.noise_variance_um2,
            noise_variance=self.noise_relative_variance,
            samples_per_rev=self.samples_per_rev,
            fit_error=self.fit_error,
            law=None if self.speed_law is None else self.speed_law.made(),
        )


class _CalibrationFile(_CalibrationTable):
    schema_version: Annotated[int, AfterValidator(_this_version), _whole(0)]
    written: str = ""
    rotor: _RotorTable
    run_up: _RunUpTable | None = None
    two_modes: _TwoModesTable | None = None
    steady: Annotated[list[_SteadyTable], _list("[[steady]] tables", of=dict)] = []


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
    path: Path | str,
    speed_rpm: float | None,
    clearance_um: float | None = None,
    *,
    plain_bearings: bool | None = None,
) -> tuple[LavalRotor, tuple[Calibration, ...]]:
    """What a file holds about the healthy machine, at one speed or at any.

    Args:
        path: the file.
        speed_rpm: shaft speed of either sign; None where it is not known yet.
        clearance_um: radial clearance, in place of the file's.
        plain_bearings: whether oil films carry the shaft; None: not known.

    Returns:
        The rotor, with the two modes of a run-up that passed the speed, and the baseline of the speed, or of
        every speed if it is not known. None at all if the file holds a run-up, which is true at any speed,
        and no baseline of that one: the first revolutions have to be the baseline then.

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
    rotor = replace(rotor, plain_bearings=plain_bearings)
    rotor = record.with_modes(rotor, speed_rpm)
    return rotor, tuple(with_rotor(baseline, rotor) for baseline in baselines)


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
    if record.two_modes is not None:
        yield from _two_modes_lines(record.two_modes)
    for calibration, source in zip(record.steady, record.steady_sources, strict=True):
        if calibration.rotor != rotor:
            raise ValueError(
                f"the baseline at {calibration.speed_rpm:.1f} rpm was made with {calibration.rotor}, the "
                f"record has {rotor}; make all baselines of a record with one rotor"
            )
        yield from _steady_lines(calibration, record.as_watched(calibration).describe(), source)


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


def _two_modes_lines(fit: TwoModeFit) -> Iterator[str]:
    modes = fit.modes
    forward, backward = modes.runout_um
    yield "\n[two_modes]"
    yield f"verdict = {_quoted(fit.describe())}"
    yield f"natural_frequency_hz = {fit.natural_frequency_hz!r}  # of the static stiffness"
    yield f"damping_ratio = {fit.damping_ratio!r}"
    yield f"eccentricity_um = {_complex(fit.eccentricity_um)}  # {_polar(fit.eccentricity_um)}"
    yield f"support_share = {modes.support_share!r}  # of the static deflection"
    yield f"support_lag = {modes.support_lag!r}  # c over k, times the natural frequency in rad/s"
    yield f"cross_stiffness = {modes.cross_stiffness!r}"
    yield f"anisotropy = {_complex(modes.anisotropy)}"
    yield f"damping_anisotropy = {_complex(modes.damping_anisotropy)}"
    yield f"gyroscopic = {modes.gyroscopic!r}"
    yield f"higher_modes = {_complex(modes.higher_modes)}"
    yield f"runout_forward_um = {_complex(forward)}"
    yield f"runout_backward_um = {_complex(backward)}"
    yield f"fit_error = {fit.fit_error!r}  # of the whirl, not explained by two modes"


def _steady_lines(calibration: Calibration, verdict: str, source: str) -> Iterator[str]:
    yield "\n[[steady]]"
    yield f"verdict = {_quoted(verdict)}"
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
    if calibration.law is not None:
        law = calibration.law
        figures = {
            f"{name}_{part}_um": getattr(row, whole).tolist()
            for name, row in zip(("slope", "rate"), law.follows_um, strict=True)
            for part, whole in (("re", "real"), ("im", "imag"))
        } | {"covariance_um2": law.covariance_um2.tolist(), "off_um": law.off_um.tolist()}
        yield "# how the components below follow the speed, which hunted: um for a relative speed of 1,"
        yield "# and um for a change of it by 1 in a revolution"
        yield f"speed_law = {{ {', '.join(f'{key} = {row!r}' for key, row in figures.items())} }}"
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
    try:
        table = _CalibrationFile.model_validate(document)
    except ValidationError as error:
        raise CalibrationFileError(f"{path}: {_message(error.errors()[0])}") from None
    if table.run_up is None and not table.steady:
        raise CalibrationFileError(f"{path}: neither [run_up] nor [[steady]] is there; calibrate again")
    rotor = LavalRotor(**table.rotor.model_dump())
    run_up = None if table.run_up is None else table.run_up.made()
    two_modes = None
    if run_up is not None and table.two_modes is not None:
        two_modes = table.two_modes.made(run_up.speed_range_rpm)
    return CalibrationRecord(
        rotor=rotor,
        steady=tuple(part.made(rotor) for part in table.steady),
        steady_sources=tuple(part.source for part in table.steady),
        run_up=run_up,
        run_up_source="" if table.run_up is None else table.run_up.source,
        two_modes=two_modes,
        written=table.written,
    )


def _message(error: ErrorDetails) -> str:
    """A mistake by key, value and remedy."""
    key = ""
    for step in error["loc"]:
        key += f"[{step}]" if key == ".steady" else "" if isinstance(step, int) else f".{step}"
    key = key.removeprefix(".")
    if error["type"] == "missing":
        return f"{key} is missing; {_RESTORE}"
    value = error.get("ctx", {}).get("value", error["input"])
    return f"{key} = {value!r}: {_MISTAKES.get(error['type'], error['msg'])}"


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
