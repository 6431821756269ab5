"""From recordings of a healthy machine to what a calibration file holds of it.

A recording through which the speed goes up or down shows the rotor. One at steady speed shows the baseline at
that speed, by the detector that watches the machine live (`analyse`), over all of its revolutions.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.detectors.rotor_synchronous.recorded import analyse, samples_of
from daqsvc.detectors.rotor_synchronous.recorded_speed import LEAST_JUDGED, speed_of
from daqsvc.dsp.probes import probes_to_xy, shaft_axes_deg
from daqsvc.dsp.quality import RefusedError
from daqsvc.dsp.quality import recorded as checks
from daqsvc.dsp.quality.unit import refuse_size
from daqsvc.dsp.speed.revolutions import KeyphasorCutter
from daqsvc.rotor.calibration.file import CalibrationRecord
from daqsvc.rotor.calibration.run_up import LEAST_SPEED_RATIO, fit_run_up, revolutions_of
from daqsvc.rotor.calibration.two_modes import fit_two_modes
from daqsvc.rotor.synchronous.baseline import LEAST_REVOLUTIONS, Calibration, NotCalibratableError
from daqsvc.rotor.synchronous.vectors import synchronous_vectors

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.detectors.rotor_synchronous.recorded_speed import RotorSetup
    from daqsvc.recording.recording import Recording
    from daqsvc.rotor.calibration.run_up import RunUpFit
    from daqsvc.rotor.calibration.two_modes import TwoModeFit

    Floats = NDArray[np.float64]

_ENDS = 0.02
"""Part of the revolutions at either end of the speeds that does not show whether a recording is a run-up."""
_SAME_SPEED = 0.01
"""Baselines at speeds that differ by less than this part are of one speed."""


class _Sweep(NamedTuple):
    """A stretch in which the shaft angle is known: orbit in um, rotation from x to y, and unwrapped angle."""

    xy_um: Floats
    angle_rad: Floats


def calibrate_recordings(
    recordings: Sequence[Recording],
    taken: RotorSetup,
    *,
    rotor_is_known: bool = True,
    sweep_rpm: tuple[float, float] | None = None,
) -> CalibrationRecord:
    """Calibrate on recordings of a healthy machine.

    Args:
        recordings: with the channels of ``taken``, by their names there; at most one run-up.
        taken: how the recordings were taken.
        rotor_is_known: whether natural frequency and damping in ``taken`` are known; if not, a run-up has to
            show them.
        sweep_rpm: speed at the first and the last sample of the first recording, which is then a run-up
            without a keyphasor, even in time; positive.

    Returns:
        The record, without a date.

    Raises:
        RefusedError: a recording that cannot be the healthy machine, by name and with the reason.
    """
    run_ups: list[tuple[Recording, RunUpFit, TwoModeFit]] = []
    steady: list[Recording] = []
    for number, recording in enumerate(recordings):
        try:
            sweep = _sweep(recording, taken, sweep_rpm if number == 0 else None)
            if sweep is None:
                steady.append(recording)
            else:
                fit = fit_run_up(*sweep, recording.rate_hz)
                run_ups.append((recording, fit, _two_modes(sweep, fit, recording.rate_hz)))
        except (RefusedError, NotCalibratableError) as error:
            raise _about(recording, error) from None
    if len(run_ups) > 1:
        raise RefusedError(
            f"{' and '.join(str(recording.source) for recording, *_ in run_ups)} are run-ups; "
            "give one of them"
        )
    run_up_recording, run_up, two_modes = run_ups[0] if run_ups else (None, None, None)
    if run_up is not None and (run_up.laval or not rotor_is_known):
        known = taken.rotor
        rotor = run_up.rotor(clearance_um=known.clearance_um, static_sag_um=known.static_sag_um)
        taken = replace(taken, rotor=rotor)
    elif not rotor_is_known:
        raise RefusedError(
            "natural frequency and damping ratio are not known: add a run-up, or give "
            "--natural-frequency-hz and --damping-ratio"
        )
    calibrations: list[Calibration] = []
    for recording in steady:
        try:
            made = replace(
                _baseline(recording, taken), fit_error=None if run_up is None else run_up.fit_error
            )
            _refuse_twice(made, calibrations)
        except RefusedError as error:
            raise _about(recording, error) from None
        calibrations.append(made)
    return CalibrationRecord(
        rotor=taken.rotor,
        steady=tuple(calibrations),
        steady_sources=tuple(str(recording.source) for recording in steady),
        run_up=run_up,
        run_up_source="" if run_up_recording is None else str(run_up_recording.source),
        two_modes=two_modes,
    )


def _two_modes(sweep: _Sweep, fit: RunUpFit, rate_hz: float) -> TwoModeFit:
    """The same run-up as a rotor with two modes."""
    vectors = synchronous_vectors(revolutions_of(sweep.xy_um[:, 0] + 1j * sweep.xy_um[:, 1], sweep.angle_rad))
    return fit_two_modes(
        vectors, rate_hz, natural_frequency_hz=fit.natural_frequency_hz, damping_ratio=fit.damping_ratio
    )


def _about(recording: Recording, error: Exception) -> RefusedError:
    return RefusedError(f"{recording.source}: {error}")


def _refuse_twice(made: Calibration, calibrations: Sequence[Calibration]) -> None:
    for other in calibrations:
        if abs(made.speed_rpm / other.speed_rpm - 1.0) < _SAME_SPEED:
            raise RefusedError(
                f"there is another recording at {other.speed_rpm:.1f} rpm; give one for each speed"
            )


def _baseline(recording: Recording, taken: RotorSetup) -> Calibration:
    """The healthy machine at the steady speed of a recording, of all its usable revolutions."""
    if taken.keyphasor is None:
        assert taken.speed_rpm is not None  # noqa: S101 - see RotorSetup
        turns = len(recording.samples) * abs(taken.speed_rpm) / 60.0 / recording.rate_hz
        _refuse_short(turns)
    # A short baseline first: it shows how many revolutions can be used.
    first = analyse(recording, _with_revolutions(taken, LEAST_REVOLUTIONS))
    if first.refused is not None or first.trace is None:
        raise RefusedError(first.refused or "no revolution can be used")
    usable = len(first.trace.vectors) - LEAST_JUDGED
    if usable <= LEAST_REVOLUTIONS:
        baseline = first
    else:
        baseline = analyse(recording, _with_revolutions(taken, usable))
        if baseline.refused is not None:
            raise RefusedError(baseline.refused)
    assert baseline.calibration is not None  # noqa: S101 - not refused
    return baseline.calibration


def _with_revolutions(taken: RotorSetup, revolutions: int) -> RotorSetup:
    rules = replace(taken.rules, calibrate_revolutions=revolutions, retry=False)
    return replace(taken, rules=rules, calibrations=())


def _refuse_short(turns: float) -> None:
    needed = LEAST_REVOLUTIONS + LEAST_JUDGED
    if turns < needed:
        raise RefusedError(
            f"the recording is too short: {turns:.1f} revolutions, a baseline needs {needed}; "
            "give a longer one"
        )


def _sweep(recording: Recording, taken: RotorSetup, sweep_rpm: tuple[float, float] | None) -> _Sweep | None:
    """Orbit and angle of a run-up; None if the recording is one at steady speed.

    Raises:
        RefusedError: the samples cannot be used.
    """
    if taken.keyphasor is None and sweep_rpm is None:
        return None
    samples = samples_of(recording, taken)
    if sweep_rpm is not None:
        sweep = _even_sweep(recording, taken, samples, sweep_rpm)
        period = 120.0 * recording.rate_hz / sum(sweep_rpm)
    else:
        keyphasor_sweep = _keyphasor_sweep(recording, taken, samples)
        if keyphasor_sweep is None:
            return None
        sweep, period = keyphasor_sweep
    refuse_size(samples[:, :2], taken.rotor.clearance_um, taken.unit)
    checks.refuse_stuck(checks.count_bad(taken.probes, samples[:, :2]), taken.probes, samples[:, :2], period)
    return sweep


def _even_sweep(
    recording: Recording, taken: RotorSetup, samples: Floats, sweep_rpm: tuple[float, float]
) -> _Sweep:
    """A speed that goes evenly from one value to another, angle zero at the first sample."""
    begin, end = (rpm * math.pi / 30.0 / recording.rate_hz for rpm in sweep_rpm)
    place = np.arange(len(samples), dtype=np.float64)
    angle = begin * place + (end - begin) / (2.0 * len(samples)) * place**2
    return _Sweep(_orbit(taken, samples[:, :2]), angle)


def _keyphasor_sweep(recording: Recording, taken: RotorSetup, samples: Floats) -> tuple[_Sweep, float] | None:
    """The longest stretch with a known angle, and samples in its median revolution; None if it is steady."""
    short = _with_revolutions(taken, 0)
    speed, _ = speed_of(recording, short, samples, checks.count_bad(tuple(taken.names), samples))
    marks = speed.keyphasor
    assert marks is not None  # noqa: S101 - taken.keyphasor
    cutter = KeyphasorCutter(
        threshold=marks.threshold_v,
        hysteresis=marks.hysteresis_v,
        period_samples=60.0 * recording.rate_hz / abs(speed.rpm),
        edge=marks.edge,
    )
    cut = cutter.process(_orbit(taken, samples[:, :2]), samples[:, 2])
    first, last = _longest(cut.trusted)
    periods = cut.period_samples[first:last]
    if len(periods) < LEAST_REVOLUTIONS:
        _refuse_short(len(periods))
    fast, slow = np.quantile(periods, [_ENDS, 1.0 - _ENDS])
    if slow < LEAST_SPEED_RATIO * fast:
        return None
    ends = np.append(cut.starts, len(cut.xy))
    part = slice(int(ends[first]), int(ends[last]))
    turn = np.repeat(np.arange(last - first), np.diff(ends[first : last + 1]))
    return _Sweep(cut.xy[part], cut.angle_rad[part] + math.tau * turn), float(np.median(periods))


def _longest(trusted: NDArray[np.bool_]) -> tuple[int, int]:
    """The longest run of True, as a half-open interval."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], trusted, [False])).astype(np.int8)))
    begins, ends = edges[::2], edges[1::2]
    if not len(begins):
        return 0, 0
    best = int(np.argmax(ends - begins))
    return int(begins[best]), int(ends[best])


def _orbit(taken: RotorSetup, probes_um: Floats) -> Floats:
    """Positions along x and y, the shaft turning from x to y."""
    clockwise = (taken.speed_rpm or 1.0) < 0.0
    return probes_um @ probes_to_xy(shaft_axes_deg(taken.probe_angles_deg, clockwise=clockwise))
