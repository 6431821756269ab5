"""Calibration: the healthy machine's synchronous vector, its scatter, and whether it can be used."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.errors.recordings import NOT_HEALTHY
from daqsvc.rotor.laval import LavalRotor, unbalance_response
from daqsvc.rotor.synchronous.departure import (
    NONSTATIONARITY_NATS,
    VECTOR_NATS,
    Spread,
    least_stationary_stretch,
    nonstationarity,
    oddest_stretch,
    threshold_for,
    turn_per_revolution,
)
from daqsvc.rotor.synchronous.speed_law import EARLIER_SPEEDS, LATE, SpeedLaw, learn, speed_terms
from daqsvc.rotor.synchronous.vectors import BACKWARD, FLOOR, FORWARD, HARMONICS, Healthy

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.vectors import SynchronousVectors

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

LEAST_REVOLUTIONS = 20
SPEED_TOLERANCE = 0.05
"""A baseline holds for speeds that differ by no more than this part: beyond, 1X itself differs."""

_NOISE_FLOOR = 1e-3
"""The same of the residual: rounding of the recording."""
_EDGE_SAMPLES = 0.29
"""A keyphasor's edge may lie anywhere between two samples: a sharp one is not interpolated."""
_TURNING_LEAVES = 0.1
"""Part of 1X that may still change without its turning, where a wrong speed is what turns it."""
_LEAST_NONSTATIONARITY = 0.15
"""Relative change of what does not repeat from which on a baseline is refused."""
_LAVAL_ELLIPTICITY = 0.05
_REVERSED = 2.0
_DOUBLED = 5.0
_LEAST_WHIRL = 3.0
"""Power of the whirl above that of noise, in standard deviations, that makes an orbit."""


class NotCalibratableError(ValueError):
    """The data cannot be the healthy baseline; the message states why and what to do."""

    code = NOT_HEALTHY


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """The healthy machine at one speed.

    Attributes:
        rotor: what is known about the rotor.
        speed_rpm: mean shaft speed.
        revolutions: revolutions that went in.
        baseline: complex128 ``[5]``, mean synchronous vector in um.
        variance: float64 ``[5]``, complex variance of one revolution's vector, as it counts in long means.
        noise: variance of a complex sample that does not repeat with the shaft (`nonstationarity`), um^2.
        noise_variance: relative variance of that from revolution to revolution.
        samples_per_rev: usable samples in a revolution.
        fit_error: what a Laval rotor leaves unexplained of a run-up, relative; None if there was none.
        law: how the vector follows the speed beyond what the rotor predicts; None where the speed was steady.
    """

    rotor: LavalRotor
    speed_rpm: float
    revolutions: int
    baseline: Complexes
    variance: Floats
    noise: float
    noise_variance: float
    samples_per_rev: float
    fit_error: float | None = None
    law: SpeedLaw | None = None

    @property
    def speed_rad_s(self) -> float:
        """Mean shaft speed Omega."""
        return self.speed_rpm * math.pi / 30.0

    @property
    def noise_um(self) -> float:
        """Standard deviation of the noise of one probe."""
        return math.sqrt(self.noise / 2.0)

    @property
    def amplitude_um(self) -> float:
        """Modulus of the forward 1X vector."""
        return float(abs(self.baseline[1]))

    @property
    def ellipticity(self) -> float:
        """Backward over forward 1X."""
        return float(abs(self.baseline[2]) / max(self.amplitude_um, 1e-12))

    @property
    def eccentricity_um(self) -> complex:
        """Complex mass eccentricity that makes the 1X vector of a Laval rotor, modulus in um."""
        response = unbalance_response(
            self.speed_rad_s / self.rotor.natural_frequency_rad_s, self.rotor.damping_ratio
        )
        return complex(self.baseline[1] / response)

    @property
    def laval(self) -> bool:
        """Whether the machine behaves like a Laval rotor, as far as was seen."""
        fits = self.fit_error is None or self.fit_error <= _LAVAL_ELLIPTICITY
        return fits and self.ellipticity <= _LAVAL_ELLIPTICITY and not self.implausible

    @property
    def implausible(self) -> bool:
        """Whether the stated rotor would need an eccentricity beyond its clearance to whirl as it does."""
        clearance_um = self.rotor.clearance_um
        return clearance_um is not None and abs(self.eccentricity_um) > clearance_um

    @property
    def snr_db(self) -> float:
        """Power of the healthy whirl over that of the noise, per sample and probe."""
        power = float(np.sum(np.abs(self.baseline[1:]) ** 2)) / 2.0
        return 10.0 * math.log10(power / max(self.noise / 2.0, 1e-30))

    @property
    def healthy(self) -> Healthy:
        """What the signatures are predicted from."""
        return Healthy(self.baseline, self.speed_rad_s, self.rotor, self.laval)

    @property
    def spread(self) -> Spread:
        """What the departure test needs."""
        steep, slope = self.rotor.speed_slope(self.speed_rad_s)
        late_rev = LATE * _settling_rev(self.rotor, self.speed_rad_s)
        return Spread(
            self.variance,
            self.noise,
            self.noise_variance,
            self.healthy.floor_um2,
            speed_slope=slope,
            amplitude_um=self.amplitude_um,
            late_um=late_rev * abs(steep) * self.amplitude_um,
            law=self.law,
        )

    @property
    def smallest_change_um(self) -> float:
        """The smallest change of a component that can be seen, at one false alarm in 10,000 revolutions."""
        return math.sqrt(threshold_for(0.1) * float(self.variance.mean()) / self.revolutions)

    def describe(self) -> str:
        """The verdict in words: what the model of this machine can and cannot separate."""
        sentences = []
        if self.laval:
            sentences.append(
                f"behaves like a Laval rotor as far as was seen (backward over forward 1X "
                f"{100.0 * self.ellipticity:.1f} %)"
            )
        else:
            why = (
                f"a run-up fits a Laval rotor only within {100.0 * (self.fit_error or 0.0):.0f} %"
                if self.fit_error is not None and self.fit_error > _LAVAL_ELLIPTICITY
                else f"its 1X takes an eccentricity of {abs(self.eccentricity_um):.3g} um, more than the "
                "clearance: check natural frequency, damping ratio and clearance"
                if self.implausible
                else f"backward over forward 1X is {100.0 * self.ellipticity:.0f} %"
            )
            consequence = (
                "the two modes of its run-up show how faults move it"
                if self.rotor.two_modes is not None
                else "generic mode, in which rub and unmodelled changes stay one group"
            )
            sentences.append(f"is no Laval rotor ({why}): {consequence}")
        smallest_um = self.smallest_change_um
        sentences.append(
            f"after {self.revolutions} revolutions the smallest change that can be seen is "
            f"{smallest_um:.2g} um, {100.0 * smallest_um / max(self.amplitude_um, 1e-12):.1f} % of 1X"
        )
        if self.rotor.two_modes is None and self.rotor.natural_frequency_tolerance > 0.05:
            sentences.append(
                "without a run-up, unbalance and loss of damping are one group unless the steady orbit "
                "excludes one of them"
            )
        return "; ".join(sentences)


def deviation_of(vectors: SynchronousVectors, speed_rad_s: float, rate_hz: float) -> Floats:
    """By what part of it each revolution's speed is off this one, float64 ``[R]``."""
    return np.asarray(2.0 * math.pi * rate_hz / vectors.period_samples / speed_rad_s - 1.0)


def compensated(
    vectors: SynchronousVectors,
    rotor: LavalRotor,
    speed_rad_s: float,
    rate_hz: float,
    law: SpeedLaw | None = None,
    before: Floats | None = None,
) -> tuple[Complexes, Floats]:
    """Vectors with 1X brought to one speed, and how each revolution's speed differs from it.

    1X itself moves with the speed; the slope d ln H / d ln Omega of the rotor takes that out to first order,
    and what was learnt of this machine (``law``) the rest.

    Args:
        vectors: of some revolutions, um.
        rotor: what is known about it.
        speed_rad_s: the one speed.
        rate_hz: sampling rate.
        law: how the machine follows its speed, where that was learnt.
        before: float64, deviations of the revolutions before.

    Returns:
        complex128 ``[R, 5]``, and float64 ``[R, 3]``: `speed_terms`.
    """
    terms = speed_terms(deviation_of(vectors, speed_rad_s, rate_hz), before)
    return _at_one_speed(vectors.vectors, terms, rotor, speed_rad_s, law), terms


def at_speed(vector: Complexes, terms: Floats, healthy: Calibration) -> Complexes:
    """One vector brought to the speed of the healthy machine, complex128 ``[5]``; see `compensated`.

    Args:
        vector: complex128 ``[5]``, um.
        terms: float64 ``[3]``, its `speed_terms`.
        healthy: the machine.
    """
    return _at_one_speed(vector, terms, healthy.rotor, healthy.speed_rad_s, healthy.law)


def _at_one_speed(
    vectors: Complexes, terms: Floats, rotor: LavalRotor, speed_rad_s: float, law: SpeedLaw | None
) -> Complexes:
    """Vectors ``[..., 5]`` with what the rotor and the law predict of their `speed_terms` taken out."""
    slope, _ = rotor.speed_slope(speed_rad_s)
    moved = vectors.copy()
    moved[..., FORWARD] /= 1.0 + slope * terms[..., 0]
    moved[..., BACKWARD] /= 1.0 + slope.conjugate() * terms[..., 0]
    return moved if law is None else np.asarray(moved - law.predicted_um(terms))


def calibrate(
    vectors: SynchronousVectors, rotor: LavalRotor, rate_hz: float, *, angle_assumed: bool = True
) -> Calibration:
    """Calibrate on revolutions of a healthy machine at steady speed.

    Args:
        vectors: synchronous vectors in um.
        rotor: what is known about the rotor.
        rate_hz: sampling rate.
        angle_assumed: whether the shaft angle rests on a stated speed instead of a keyphasor.

    Raises:
        NotCalibratableError: too few revolutions, no orbit, not stationary, not locked to the shaft, or an
            orbit that turns against the shaft.
    """
    vectors = vectors[vectors.usable]
    count = len(vectors)
    if count < LEAST_REVOLUTIONS:
        raise NotCalibratableError(
            f"only {count} usable revolutions; a baseline needs {LEAST_REVOLUTIONS}: give a longer recording"
        )
    speed_rad_s = float(2.0 * math.pi * rate_hz / vectors.period_samples.mean())
    moved, terms = compensated(vectors, rotor, speed_rad_s, rate_hz)
    samples = float(vectors.samples.mean())
    # What the first revolutions owe to the speed before them is not known.
    known = slice(EARLIER_SPEEDS, None)
    law = _learnt(moved[known], terms[known], float(vectors.noise.mean()) / samples, rotor, speed_rad_s)
    if law is not None:
        moved, terms, vectors = (moved - law.predicted_um(terms))[known], terms[known], vectors[known]
    baseline = moved.mean(axis=0)
    amplitude = float(np.sqrt(np.sum(np.abs(baseline[1:]) ** 2)))
    noise = max(float(vectors.noise.mean()), (_NOISE_FLOOR * amplitude) ** 2)
    white = noise / samples
    variance = _long_run_variance(moved, white, _memory(rotor, speed_rad_s))
    _refuse_no_orbit(vectors.vectors, white)
    nonstationary = nonstationarity(
        moved, np.maximum(vectors.noise, (_NOISE_FLOOR * amplitude) ** 2), vectors.samples, baseline
    )
    _refuse_unsteady(moved, white, rotor, speed_rad_s, terms, samples, law, assumed=angle_assumed)
    _refuse_nonstationary(nonstationary, samples, 0.0 if angle_assumed else amplitude * math.pi / samples)
    relative = nonstationary / nonstationary.mean()
    freedom = 1.0 / max(samples - 5.0, 1.0)
    return Calibration(
        rotor=rotor,
        speed_rpm=speed_rad_s * 30.0 / math.pi,
        revolutions=count,
        baseline=baseline,
        variance=variance,
        noise=float(nonstationary.mean()),
        noise_variance=max(freedom, float(relative.var(ddof=1))),
        samples_per_rev=samples,
        law=law,
    )


def with_more(calibration: Calibration, baseline: Complexes, revolutions: int) -> Calibration:
    """The same calibration with a baseline that has grown."""
    return replace(calibration, baseline=baseline, revolutions=revolutions)


def learnt_again(
    calibration: Calibration, moved: Complexes, terms: Floats, of_baseline: Floats
) -> tuple[Calibration, Complexes] | None:
    """The same calibration with what more healthy revolutions teach of how 1X follows the speed.

    The baseline stays that of its own revolutions: what has grown slowly since then is a change.

    Args:
        calibration: what was known before.
        moved: complex128 ``[R, 5]``, vectors of all, um, with only what the stated rotor predicts taken out.
        terms: float64 ``[R, 3]``, their `speed_terms`.
        of_baseline: float64 ``[3]``, mean `speed_terms` of the revolutions that made the baseline.

    Returns:
        The calibration, and complex128 ``[R, 5]``, the vectors brought to its speed; None where the speed
        does not hunt.
    """
    rotor, speed_rad_s = calibration.rotor, calibration.speed_rad_s
    white = calibration.noise / calibration.samples_per_rev
    law = _learnt(moved, terms, white, rotor, speed_rad_s)
    if law is None:
        return None
    steady = moved - law.predicted_um(terms)
    variance = _long_run_variance(steady, white, _memory(rotor, speed_rad_s))
    return replace(with_law(calibration, law, of_baseline), variance=variance), steady


def with_law(calibration: Calibration, law: SpeedLaw | None, of_baseline: Floats) -> Calibration:
    """The same calibration where its revolutions are brought to its speed by another law.

    Args:
        calibration: the healthy machine.
        law: how its vector follows the speed.
        of_baseline: float64 ``[3]``, mean `speed_terms` of the revolutions that made the baseline.
    """
    was, now = (0.0 if one is None else one.predicted_um(of_baseline) for one in (calibration.law, law))
    return replace(calibration, law=law, baseline=calibration.baseline + was - now)


def with_rotor(calibration: Calibration, rotor: LavalRotor) -> Calibration:
    """The same calibration where other figures of the rotor are stated.

    A law is what these figures leave unexplained: what they explain now that they did not, it has no more.

    Args:
        calibration: the healthy machine.
        rotor: what is known about it now.
    """
    law = calibration.law
    if law is not None:
        was, _ = calibration.rotor.speed_slope(calibration.speed_rad_s)
        now, _ = rotor.speed_slope(calibration.speed_rad_s)
        follows = law.follows_um.copy()
        follows[0, FORWARD] += (was - now) * calibration.baseline[FORWARD]
        follows[0, BACKWARD] += (was - now).conjugate() * calibration.baseline[BACKWARD]
        law = replace(law, follows_um=follows)
    return replace(calibration, rotor=rotor, law=law)


def begun_at(calibration: Calibration, vectors: SynchronousVectors, rate_hz: float) -> Calibration:
    """The same calibration with shaft angle zero where these vectors have it.

    Without a keyphasor it is where a recording begins, which is another angle each time. So the phase of 1X
    is that of the vectors; its amplitude and all other components stay those of the calibration.

    Args:
        calibration: the healthy machine.
        vectors: of the first revolutions, in um.
        rate_hz: sampling rate.
    """
    moved, _ = compensated(vectors[vectors.usable], calibration.rotor, calibration.speed_rad_s, rate_hz)
    if not len(moved):
        return calibration
    phase = float(np.angle(moved[:, 1].mean() * calibration.baseline[1].conjugate()))
    turn = np.exp(1j * phase * np.array(HARMONICS))
    law = calibration.law
    return replace(
        calibration, baseline=calibration.baseline * turn, law=None if law is None else law.turned(turn)
    )


def _learnt(
    moved: Complexes, terms: Floats, white: float, rotor: LavalRotor, speed_rad_s: float
) -> SpeedLaw | None:
    settling_rev = _settling_rev(rotor, speed_rad_s)
    return learn(moved, terms, np.full(5, white), *rotor.speed_slope(speed_rad_s), settling_rev)


def _settling_rev(rotor: LavalRotor, speed_rad_s: float) -> float:
    """Revolutions in which the free motion dies away, to 1/e."""
    return 1.0 / (2.0 * math.pi * _decay(rotor, speed_rad_s))


def _memory(rotor: LavalRotor, speed_rad_s: float) -> float:
    """Correlation of a stirred orbit from one revolution to the next."""
    return math.exp(-2.0 * math.pi * _decay(rotor, speed_rad_s))


def _decay(rotor: LavalRotor, speed_rad_s: float) -> float:
    """By what power of e the free motion dies away, while the shaft turns by 1."""
    return rotor.damping_ratio * rotor.natural_frequency_rad_s / abs(speed_rad_s)


def _long_run_variance(vectors: Complexes, white: float, memory: float) -> Floats:
    """v_k: variance of one revolution's vector as it counts in means of many.

    What is above the white noise is the stirred orbit, correlated from revolution to revolution. A trend is
    taken out first: the test of steadiness judges it, and it must not hide there.
    """
    time = np.arange(len(vectors)) - (len(vectors) - 1) / 2.0
    level = vectors - vectors.mean(axis=0)
    trend = (time @ level) / (time @ time)
    scatter = np.sum(np.abs(level - np.outer(time, trend)) ** 2, axis=0) / (len(vectors) - 2)
    stirred = np.maximum(scatter - white, 0.0)
    return np.asarray(white + stirred * (1.0 + memory) / (1.0 - memory))


def _refuse_no_orbit(vectors: Complexes, white: float) -> None:
    """Whether there is an orbit that turns with the shaft, once in a revolution, whether steady or not."""
    size = np.sqrt(np.mean(np.abs(vectors) ** 2, axis=0))
    if np.sum(size[1:] ** 2) < 4.0 * white * (1.0 + _LEAST_WHIRL / math.sqrt(len(vectors))):
        raise NotCalibratableError(
            f"there is no orbit: 1X is {size[1]:.3g} um, as noise alone makes it; check that the machine "
            "turns, the probes' names and their unit"
        )
    if size[2] > _REVERSED * size[1]:
        raise NotCalibratableError(
            f"the orbit turns against the stated rotation (backward 1X {size[2]:.3g} um, forward "
            f"{size[1]:.3g} um): x and y are swapped, one probe has the wrong sign, or the shaft turns "
            "clockwise; swap the probes, or give the speed a minus sign"
        )
    if size[3] > _DOUBLED * size[1]:
        raise NotCalibratableError(
            f"2X is {size[3]:.3g} um where 1X is {size[1]:.3g} um: the angle turns half as fast as the "
            "shaft; check that the keyphasor gives one pulse a revolution, and the stated speed"
        )


def _refuse_unsteady(
    moved: Complexes,
    white: float,
    rotor: LavalRotor,
    speed_rad_s: float,
    terms: Floats,
    samples: float,
    law: SpeedLaw | None,
    *,
    assumed: bool,
) -> None:
    """Whether any stretch of the revolutions differs from the others; if so, state how.

    Args:
        moved: complex128 ``[R, 5]``, vectors brought to one speed.
        white: variance of a component that white noise makes.
        rotor: what is known about the rotor.
        speed_rad_s: mean speed.
        terms: float64 ``[R, 3]``, `speed_terms` of every revolution.
        samples: samples in a revolution.
        law: how the vector follows the speed, where that was learnt.
        assumed: whether the angle rests on a stated speed.
    """
    amplitude = float(np.median(np.abs(moved[:, 1])))
    memory, floor = _memory(rotor, speed_rad_s), (FLOOR * amplitude) ** 2
    _, slope = rotor.speed_slope(speed_rad_s)
    guard = amplitude * slope * terms[:, :1]
    if law is not None:
        guard = law.doubts_um(terms)
        floor += float(law.off_um.max()) ** 2
    jitter_rad = 0.0 if assumed else _EDGE_SAMPLES * 2.0 * math.pi / samples
    odd = oddest_stretch(moved, white, memory, floor, guard, jitter_rad)
    if odd.nats <= VECTOR_NATS:
        return
    turn = turn_per_revolution(moved[:, 1]) if assumed else 0.0
    if turn:
        still = moved * np.exp(-1j * turn * np.outer(np.arange(len(moved)), HARMONICS))
        left = oddest_stretch(still, white, memory, floor, guard)
        if left.nats <= VECTOR_NATS or left.by <= _TURNING_LEAVES * amplitude:
            speed_rpm = speed_rad_s * 30.0 / math.pi
            orbit_rpm = speed_rpm * (1.0 + turn / (2.0 * math.pi))
            raise NotCalibratableError(
                f"the angle is not locked to the shaft: 1X turns by {math.degrees(turn):.2f} degrees a "
                f"revolution against it, so the shaft turns at {orbit_rpm:.1f} rpm and not at "
                f"{speed_rpm:.1f} rpm ({100.0 * (orbit_rpm / speed_rpm - 1.0):+.2f} %); correct the speed, "
                "or use a keyphasor"
            )
    by_chance = odd.by * math.sqrt(VECTOR_NATS / odd.nats)
    raise NotCalibratableError(
        f"not steady: {odd.what} moves by {odd.by:.3g} um in revolutions {odd.begin + 1} to {odd.end} of "
        f"{len(moved)} (by chance it moves by {by_chance:.3g} um at most); calibrate where the machine runs "
        "steadily and is healthy"
    )


def _refuse_nonstationary(values: Floats, samples: float, jitter_um: float) -> None:
    """Whether what does not repeat with the shaft comes or goes.

    Args:
        values: float64 ``[R]``, nonstationarity of every revolution, um^2.
        samples: samples in a revolution.
        jitter_um: error of the whirl if the keyphasor edges are off by half a sample.
    """
    stretch = least_stationary_stretch(values, samples)
    usual = math.sqrt(float(np.median(values)) / 2.0)
    if (
        stretch.nats <= NONSTATIONARITY_NATS
        or abs(stretch.by / max(usual, 1e-300) - 1.0) < _LEAST_NONSTATIONARITY
    ):
        return
    if abs(stretch.by**2 - usual**2) < jitter_um**2:
        return
    raise NotCalibratableError(
        f"not steady: noise and whirl that do not repeat with the shaft are {stretch.by:.3g} um in "
        f"revolutions {stretch.begin + 1} to {stretch.end} of {len(values)}, else {usual:.3g} um; "
        "calibrate where the machine runs steadily and is healthy"
    )
