"""What ``daqsvc calibrate`` states of what it found."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

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


def speeds_to_predict(fit: RunUpFit, asked: Sequence[float] | None) -> tuple[float, ...]:
    """Speeds in rpm at which the run-up states something; those asked for, or parts of the critical one."""
    if not fit.laval:
        return ()
    if asked is not None:
        return tuple(asked)
    low, high = fit.speed_range_rpm
    parts = (60.0 * fit.natural_frequency_hz * part for part in _OF_CRITICAL)
    return tuple(speed for speed in parts if low <= speed <= high)


def as_json(record: CalibrationRecord, asked: Sequence[float] | None, out: Path | None) -> dict[str, Any]:
    """One JSON object: lengths in um, uncertainties are standard deviations."""
    rotor = record.rotor
    document: dict[str, Any] = finite(
        {
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
            "run_up": None
            if record.run_up is None
            else {"source": record.run_up_source, **_run_up_json(record.run_up, asked)},
            "two_modes": None if record.two_modes is None else _two_modes_json(record.two_modes),
            "steady": [
                {"source": source, **_steady_json(record, calibration)}
                for calibration, source in zip(record.steady, record.steady_sources, strict=True)
            ],
        }
    )
    return document


def bearings_as_json(baseline: BearingBaseline, out: object) -> dict[str, Any]:
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


def _run_up_json(fit: RunUpFit, asked: Sequence[float] | None) -> dict[str, Any]:
    return {
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


def _two_modes_json(fit: TwoModeFit) -> dict[str, Any]:
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


def _steady_json(record: CalibrationRecord, calibration: Calibration) -> dict[str, Any]:
    deviations = _deviations(calibration)
    return {
        **calibration_json(calibration),
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
        f"the machine {calibration.describe()}",
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
