"""What ``daqsvc calibrate`` states of what it found."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypedDict

from daqsvc.detectors.shaft.verdict import calibration_json
from daqsvc.diagnosis.recorded import finite
from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from daqsvc.bearing.baseline import BearingBaseline
    from daqsvc.rotor.calibration.file import CalibrationRecord
    from daqsvc.rotor.calibration.run_up import RunUpFit
    from daqsvc.rotor.calibration.two_modes import TwoModeFit
    from daqsvc.rotor.synchronous.baseline import Calibration

_OF_CRITICAL = (0.5, 0.7, 0.95, 1.0)


class Refused(TypedDict):
    """The recordings do not suffice.

    Attributes:
        refused: why, in a sentence.
        code: code of that reason.
    """

    refused: str
    code: str


class RotorFiguresJson(TypedDict):
    """The rotor as a Laval rotor.

    Attributes:
        natural_frequency_hz: its natural frequency.
        natural_frequency_tolerance: how far that may be off, as a share.
        damping_ratio: its damping ratio.
        damping_tolerance: how far that may be off, as a share.
        clearance_um: clearance; null if it is not known.
        static_sag_um: static sag; null if it is not known.
    """

    natural_frequency_hz: float
    natural_frequency_tolerance: float
    damping_ratio: float
    damping_tolerance: float
    clearance_um: float | None
    static_sag_um: float | None


class PredictedJson(TypedDict):
    """1X as the run-up predicts it at a speed.

    Attributes:
        speed_rpm: the speed.
        amplitude_um: amplitude of 1X.
        phase_deg: phase of 1X.
        uncertainty_um: its standard deviation.
    """

    speed_rpm: float
    amplitude_um: float
    phase_deg: float
    uncertainty_um: float


class RunUpJson(TypedDict):
    """What the run-up shows.

    Attributes:
        source: name of the recording.
        revolutions: revolutions that were fitted.
        speed_range_rpm: least and greatest speed.
        natural_frequency_hz: natural frequency.
        natural_frequency_uncertainty_hz: its standard deviation.
        critical_speed_rpm: the same as a speed.
        damping_ratio: damping ratio.
        damping_uncertainty: its standard deviation.
        eccentricity_um: eccentricity of the mass.
        eccentricity_uncertainty_um: its standard deviation.
        heavy_spot_deg: where the heavy spot is.
        heavy_spot_uncertainty_deg: its standard deviation.
        centre_um: centre of the whirl, x and y.
        centre_uncertainty_um: its standard deviation.
        ellipticity: backward over forward whirl.
        noise_um: noise of a sample, standard deviation.
        fit_error: what the fit leaves, as a share.
        laval: whether the machine is like a Laval rotor.
        verdict: what the machine is like, in words.
        predicted_1x: what 1X is at some speeds; null if the machine is no Laval rotor.
    """

    source: str
    revolutions: int
    speed_range_rpm: list[float]
    natural_frequency_hz: float
    natural_frequency_uncertainty_hz: float | None
    critical_speed_rpm: float
    damping_ratio: float
    damping_uncertainty: float | None
    eccentricity_um: float
    eccentricity_uncertainty_um: float | None
    heavy_spot_deg: float
    heavy_spot_uncertainty_deg: float | None
    centre_um: list[float]
    centre_uncertainty_um: float | None
    ellipticity: float
    noise_um: float
    fit_error: float
    laval: bool
    verdict: str
    predicted_1x: list[PredictedJson] | None


class TwoModesJson(TypedDict):
    """The run-up with two modes: the rotor and its support.

    Attributes:
        natural_frequency_hz: natural frequency of the rotor.
        damping_ratio: its damping ratio.
        support_share: how much of the flexibility is that of the support.
        anisotropy: how much the support differs by direction.
        gyroscopic: how much the modes part with speed.
        fit_error: what the fit leaves, as a share.
        explains: whether two modes explain the run-up.
        verdict: what the machine is like, in words.
    """

    natural_frequency_hz: float
    damping_ratio: float
    support_share: float
    anisotropy: float
    gyroscopic: float
    fit_error: float
    explains: bool
    verdict: str


class SteadyJson(TypedDict):
    """The healthy machine at one speed.

    Attributes:
        source: name of the recording.
        vector_um: by order the vector, real and imaginary part.
        vector_uncertainty_um: by order its standard deviation.
        eccentricity_um: eccentricity of the mass; null if the machine is no Laval rotor.
        heavy_spot_deg: where the heavy spot is; null if the machine is no Laval rotor.
        fit_error: what the fit of the run-up leaves, as a share; null without one.
        off_prediction: how far 1X is from what the run-up predicts, as a share; null without one.
        revolutions: healthy revolutions that were measured.
        speed_rpm: mean speed of the shaft.
        amplitude_um: amplitude of forward 1X.
        phase_deg: phase of forward 1X.
        ellipticity: backward over forward 1X.
        noise_um: noise of a sample, standard deviation.
        snr_db: whirl over noise.
        laval: whether the machine is like a Laval rotor.
        reference_revolutions: revolutions that the baseline rests on.
        smallest_change_um: the smallest change that can be seen.
        verdict: what the machine is like, in words.
    """

    source: str
    vector_um: dict[str, list[float]]
    vector_uncertainty_um: dict[str, float]
    eccentricity_um: float | None
    heavy_spot_deg: float | None
    fit_error: float | None
    off_prediction: float | None
    revolutions: int
    speed_rpm: float
    amplitude_um: float
    phase_deg: float
    ellipticity: float
    noise_um: float
    snr_db: float | None
    laval: bool
    reference_revolutions: int
    smallest_change_um: float | None
    verdict: str


class RotorCalibrationJson(TypedDict):
    """The calibrated rotor; lengths in um, uncertainties are standard deviations.

    Attributes:
        refused: null.
        out: file that it was written to; null if to none.
        written: when, ISO 8601.
        rotor: the rotor.
        run_up: what the run-up shows; null without one.
        two_modes: the run-up with two modes; null if one suffices.
        steady: the healthy machine, one for each speed.
    """

    refused: None
    out: str | None
    written: str
    rotor: RotorFiguresJson
    run_up: RunUpJson | None
    two_modes: TwoModesJson | None
    steady: list[SteadyJson]


class BearingModelJson(TypedDict):
    """The model of the healthy signal of some channels.

    Attributes:
        channels: names of the channels.
        order: order of the model.
        spectral_radius: its largest pole.
        whiteness_p: probability that what it does not predict is white.
        predictable: share of that which can still be predicted.
        windows: windows that were compared.
        window_s: length of a window, in s.
        spread_db: how much windows differ, in dB.
    """

    channels: list[str]
    order: int
    spectral_radius: float
    whiteness_p: float
    predictable: float
    windows: int
    window_s: float
    spread_db: float


class HealthyLineJson(TypedDict):
    """The lines of a part of a healthy bearing.

    Attributes:
        z: their significance, in standard deviations of noise.
        size: modulation by them in the whitened envelope.
    """

    z: float
    size: float


class BearingsCalibrationJson(TypedDict):
    """The healthy state of bearings.

    Attributes:
        refused: null.
        source: name of the recording.
        written_to: file that it was written to; null if to none.
        rate_hz: samples per second.
        speed_rpm: speed of the shaft.
        models: models of the healthy signals.
        lines: by channel and part the lines of the healthy bearing.
    """

    refused: None
    source: str
    written_to: str | None
    rate_hz: float
    speed_rpm: float
    models: list[BearingModelJson]
    lines: dict[str, dict[str, HealthyLineJson]]


def speeds_to_predict(fit: RunUpFit, asked: Sequence[float] | None) -> tuple[float, ...]:
    """Speeds in rpm at which the run-up states something; those asked for, or parts of the critical one."""
    if not fit.laval:
        return ()
    if asked is not None:
        return tuple(asked)
    low, high = fit.speed_range_rpm
    parts = (60.0 * fit.natural_frequency_hz * part for part in _OF_CRITICAL)
    return tuple(speed for speed in parts if low <= speed <= high)


def as_json(
    record: CalibrationRecord, asked: Sequence[float] | None, out: Path | None
) -> RotorCalibrationJson:
    """One JSON object: lengths in um, uncertainties are standard deviations."""
    rotor = record.rotor
    document: RotorCalibrationJson = {
        "refused": None,
        "out": None if out is None else str(out),
        "written": record.written,
        "rotor": {
            "natural_frequency_hz": rotor.natural_frequency_hz,
            "natural_frequency_tolerance": rotor.natural_frequency_tolerance,
            "damping_ratio": rotor.damping_ratio,
            "damping_tolerance": rotor.damping_tolerance,
            "clearance_um": rotor.clearance_um,
            "static_sag_um": rotor.sag_um,
        },
        "run_up": None if record.run_up is None else _run_up_json(record.run_up, record.run_up_source, asked),
        "two_modes": None if record.two_modes is None else _two_modes_json(record.two_modes),
        "steady": [
            _steady_json(record, calibration, source)
            for calibration, source in zip(record.steady, record.steady_sources, strict=True)
        ],
    }
    return finite(document)


def bearings_as_json(baseline: BearingBaseline, out: object) -> BearingsCalibrationJson:
    """The healthy state of bearings, and where it was written to."""
    return {
        "refused": None,
        "source": baseline.source,
        "written_to": None if out is None else str(out),
        "rate_hz": baseline.rate_hz,
        "speed_rpm": baseline.speed_rpm,
        "models": [
            {
                "channels": list(channels),
                "order": residual.model.order,
                "spectral_radius": residual.model.spectral_radius,
                "whiteness_p": residual.model.whiteness.p_value,
                "predictable": residual.model.whiteness.predictable,
                "windows": residual.windows,
                "window_s": residual.window_samples / baseline.rate_hz,
                "spread_db": float(residual.spread_db[0]),
            }
            for channels, residual in baseline.residuals.items()
        ],
        "lines": {
            channel: {part: {"z": e.z, "size": e.depth} for part, e in race.evidence.items()}
            for channel, race in baseline.races.items()
        },
    }


def bearings_as_text(baseline: BearingBaseline, out: object) -> str:
    """The same in lines for a person."""
    lines = [f"{baseline.source}: {baseline.rate_hz:g} Hz, {baseline.speed_rpm:g} rpm"]
    for channels, residual in baseline.residuals.items():
        model = residual.model
        lines.append(
            f"{' and '.join(channels)}: autoregressive of order {model.order}, stable (largest pole "
            f"{model.spectral_radius:.4f}); {100.0 * model.whiteness.predictable:.2g} % of the innovations "
            f"can still be predicted; {residual.windows} windows of "
            f"{residual.window_samples / baseline.rate_hz:.3g} s differ by {residual.spread_db[0]:.2f} dB"
        )
    if out is not None:
        lines.append(f"written to {out}")
    return "\n  ".join(lines)


def _run_up_json(fit: RunUpFit, source: str, asked: Sequence[float] | None) -> RunUpJson:
    return {
        "source": source,
        "revolutions": fit.revolutions,
        "speed_range_rpm": list(fit.speed_range_rpm),
        "natural_frequency_hz": fit.natural_frequency_hz,
        "natural_frequency_uncertainty_hz": fit.natural_frequency_uncertainty_hz,
        "critical_speed_rpm": 60.0 * fit.natural_frequency_hz,
        "damping_ratio": fit.damping_ratio,
        "damping_uncertainty": fit.damping_uncertainty,
        "eccentricity_um": abs(fit.eccentricity_um),
        "eccentricity_uncertainty_um": fit.eccentricity_uncertainty_um,
        "heavy_spot_deg": _degrees(fit.eccentricity_um),
        "heavy_spot_uncertainty_deg": fit.heavy_spot_uncertainty_deg,
        "centre_um": [fit.centre_um.real, fit.centre_um.imag],
        "centre_uncertainty_um": fit.centre_uncertainty_um,
        "ellipticity": fit.ellipticity,
        "noise_um": fit.noise_um,
        "fit_error": fit.fit_error,
        "laval": fit.laval,
        "verdict": fit.describe(),
        "predicted_1x": [
            {
                "speed_rpm": speed,
                "amplitude_um": abs(vector),
                "phase_deg": _degrees(vector),
                "uncertainty_um": sd,
            }
            for speed in speeds_to_predict(fit, asked)
            for vector, sd in [fit.predict(speed)]
        ]
        if fit.laval
        else None,
    }


def _two_modes_json(fit: TwoModeFit) -> TwoModesJson:
    return {
        "natural_frequency_hz": fit.natural_frequency_hz,
        "damping_ratio": fit.damping_ratio,
        "support_share": fit.modes.support_share,
        "anisotropy": abs(fit.modes.anisotropy),
        "gyroscopic": fit.modes.gyroscopic,
        "fit_error": fit.fit_error,
        "explains": fit.explains,
        "verdict": fit.describe(),
    }


def _steady_json(record: CalibrationRecord, calibration: Calibration, source: str) -> SteadyJson:
    deviations = _deviations(calibration)
    return {
        "source": source,
        **calibration_json(record.as_watched(calibration)),
        "vector_um": {
            str(order): [value.real, value.imag]
            for order, value in zip(HARMONICS, calibration.baseline.tolist(), strict=True)
        },
        "vector_uncertainty_um": {
            str(order): deviation for order, deviation in zip(HARMONICS, deviations, strict=True)
        },
        "eccentricity_um": abs(calibration.eccentricity_um) if calibration.laval else None,
        "heavy_spot_deg": _degrees(calibration.eccentricity_um) if calibration.laval else None,
        "fit_error": calibration.fit_error,
        "off_prediction": _off_prediction(record.run_up, calibration),
    }


def as_text(record: CalibrationRecord, asked: Sequence[float] | None) -> str:
    """The same in lines for a person."""
    lines: list[str] = []
    if record.run_up is not None:
        lines += _run_up_lines(record.run_up, record.run_up_source, asked)
        if record.two_modes is not None:
            lines += _indented([record.two_modes.describe()])
    else:
        rotor = record.rotor
        lines.append(
            f"rotor as given: natural frequency {rotor.natural_frequency_hz:.4g} Hz +- "
            f"{100.0 * rotor.natural_frequency_tolerance:g} %, damping ratio {rotor.damping_ratio:.3g} +- "
            f"{100.0 * rotor.damping_tolerance:g} %"
        )
    for calibration, source in zip(record.steady, record.steady_sources, strict=True):
        lines += _steady_lines(record, calibration, source)
    return "\n".join(lines)


def _run_up_lines(fit: RunUpFit, source: str, asked: Sequence[float] | None) -> list[str]:
    low, high = fit.speed_range_rpm
    kind = "" if fit.laval else "nearest Laval rotor: "
    frequency = (
        f"{kind}natural frequency {fit.natural_frequency_hz:.3f} +- "
        f"{fit.natural_frequency_uncertainty_hz:.2g} Hz (critical speed "
        f"{60.0 * fit.natural_frequency_hz:.1f} rpm), damping ratio {fit.damping_ratio:.4f} +- "
        f"{fit.damping_uncertainty:.2g}"
    )
    unbalance = (
        f"eccentricity {abs(fit.eccentricity_um):.4g} +- {fit.eccentricity_uncertainty_um:.2g} um at "
        f"{_degrees(fit.eccentricity_um):z.1f} +- {fit.heavy_spot_uncertainty_deg:.2g} degrees, centre "
        f"({fit.centre_um.real:.4g}, {fit.centre_um.imag:.4g}) +- {fit.centre_uncertainty_um:.2g} um"
    )
    errors = (
        f"noise {fit.noise_um:.3g} um a sample, fit error {100.0 * fit.fit_error:.2g} %, backward over "
        f"forward whirl {100.0 * fit.ellipticity:.2g} %"
    )
    lines = [frequency, unbalance, errors, fit.describe()]
    for speed in speeds_to_predict(fit, asked):
        vector, deviation = fit.predict(speed)
        lines.append(
            f"predicted 1X at {speed:.0f} rpm: {abs(vector):.4g} +- {deviation:.2g} um at "
            f"{_degrees(vector):z.1f} degrees"
        )
    return [f"{source}: {fit.revolutions} revolutions from {low:.0f} to {high:.0f} rpm", *_indented(lines)]


def _steady_lines(record: CalibrationRecord, calibration: Calibration, source: str) -> list[str]:
    deviations = _deviations(calibration)
    mean, forward = calibration.baseline[0], calibration.baseline[1]
    whirl = (
        f"1X {abs(forward):.4g} +- {deviations[1]:.2g} um at {_degrees(forward):z.1f} degrees, backward over "
        f"forward 1X {100.0 * calibration.ellipticity:.2g} %"
    )
    lines = [whirl]
    if (off := _off_prediction(record.run_up, calibration)) is not None:
        lines.append(f"1X is {100.0 * off:.2g} % off what the run-up predicts")
    lines += [
        f"mean position ({mean.real:.4g}, {mean.imag:.4g}) +- {deviations[0]:.2g} um",
        f"noise {calibration.noise_um:.3g} um a sample, SNR {calibration.snr_db:.1f} dB",
        f"the machine {record.as_watched(calibration).describe()}",
    ]
    head = f"{source}: {calibration.revolutions} revolutions at {calibration.speed_rpm:.2f} rpm"
    return [head, *_indented(lines)]


def _indented(lines: Sequence[str]) -> list[str]:
    return [f"  {line}" for line in lines]


def _off_prediction(fit: RunUpFit | None, calibration: Calibration) -> float | None:
    """How far 1X is from what the run-up predicts, relative; None if nothing is predicted there."""
    if fit is None or not fit.laval:
        return None
    low, high = fit.speed_range_rpm
    if not low <= calibration.speed_rpm <= high:
        return None
    predicted, _ = fit.predict(calibration.speed_rpm)
    return abs(complex(calibration.baseline[1]) - predicted) / abs(predicted)


def _deviations(calibration: Calibration) -> list[float]:
    """Standard deviation of each coordinate of the components of the baseline, um."""
    return [math.sqrt(v / calibration.revolutions / 2.0) for v in calibration.variance.tolist()]


def _degrees(vector: complex) -> float:
    return math.degrees(math.atan2(vector.imag, vector.real))
