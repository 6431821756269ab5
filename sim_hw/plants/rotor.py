"""The Laval rotor with rub impact: a thin disc on an elastic shaft inside a housing it can touch.

Equations of motion of the paper, section II, normalised by the radial clearance c and by the natural
frequency omega_s = sqrt(K_s / M) of the healthy shaft, with tau = omega_s t and r = hypot(x, y)::

    x'' + 2 zeta x' + k x = e w^2 cos(w tau + phi) + l_x         + f_x
    y'' + 2 zeta y' + k y = e w^2 sin(w tau + phi) - g - l       + f_y

    f_x = -K* (r - 1)^alpha (x - m y) / r
    f_y = -K* (r - 1)^alpha (y + m x) / r       where r > 1, else 0
    m   = mu sign(w R + (x y' - y x') / r)

The housing pushes inwards and friction opposes the sliding of the disc's rim. The paper prints the
contact force of its state equation with the other sign, which throws the rotor out of its housing.
Friction follows the sign of the sliding speed at the rim, so that a rotor whirling backwards faster
than its rim turns is not driven any further.

The integrator is LSODA with tolerances far below any sensor's noise. Nothing here is shared with the
observers, so that they are never tested on their own arithmetic.
"""

from __future__ import annotations

import cmath
import itertools
import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from scipy.integrate import odeint

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]
    Coefficients: TypeAlias = tuple[float, ...]


ESCAPE_RADIUS = 3.0
"""Distance of the disc from the centre, in clearances, at which a simulation is given up."""

RELATIVE_TOLERANCE = 1e-10
ABSOLUTE_TOLERANCE = 1e-12
MAX_STEPS_PER_SAMPLE = 100_000


class RotorEscapeError(ArithmeticError):
    """The rotor left its housing: these parameters have no bounded motion."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantParameters:
    """One operating condition of the rotor, dimensionless as in the paper.

    Attributes:
        damping_ratio: zeta = D_s / (2 M omega_s).
        stiffness: k = K_s / (M omega_s^2), 1 for the healthy shaft.
        eccentricity: e, of the centre of mass, in clearances.
        speed_ratio: w = Omega / omega_s.
        heavy_spot_deg: phi, angle of the centre of mass from +x at shaft angle zero.
        gravity: g = G / (M c omega_s^2), towards -y; the sag of the shaft is g / k clearances.
        static_load: l, of the same kind and in the same direction as ``gravity``.
        side_load: l_x, of the same kind, towards +x.
        contact_stiffness: K* = K_beta / (M c omega_s^2).
        contact_exponent: alpha; 1.5 for a Hertzian contact.
        friction: mu, Coulomb's coefficient between rim and housing.
        disc_radius: R, in clearances; 500 is a 50 mm radius in a 0.1 mm clearance.

    Raises:
        ValueError: a parameter is out of its range.
    """

    damping_ratio: float = 0.18
    stiffness: float = 1.0
    eccentricity: float = 0.1
    speed_ratio: float = 1.0
    heavy_spot_deg: float = 0.0
    gravity: float = 0.1
    static_load: float = 0.0
    side_load: float = 0.0
    contact_stiffness: float = 30.0
    contact_exponent: float = 1.5
    friction: float = 0.3
    disc_radius: float = 500.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not math.isfinite(value):
                raise ValueError(f"rotor parameter {name} is {value}; it must be a finite number")
        for name in ("damping_ratio", "stiffness", "speed_ratio", "disc_radius"):
            if getattr(self, name) <= 0:
                raise ValueError(f"rotor parameter {name} is {getattr(self, name)}; it must be positive")
        for name in ("eccentricity", "contact_stiffness", "friction"):
            if getattr(self, name) < 0:
                raise ValueError(f"rotor parameter {name} is {getattr(self, name)}; it cannot be negative")
        if self.contact_exponent < 1:
            raise ValueError(
                f"rotor parameter contact_exponent is {self.contact_exponent}; "
                "it must be at least 1 (1.5 is a Hertzian contact)"
            )

    @property
    def orbit_1x(self) -> complex:
        """Phasor of the steady 1X orbit without contact: x + iy = orbit_1x e^(i w tau) + rest."""
        w = self.speed_ratio
        drive = self.eccentricity * w**2 * cmath.exp(1j * math.radians(self.heavy_spot_deg))
        return drive / (self.stiffness - w**2 + 2j * self.damping_ratio * w)

    @property
    def rest(self) -> complex:
        """Where the shaft's centre rests under its static loads, x + iy in clearances."""
        return complex(self.side_load, -self.gravity - self.static_load) / self.stiffness

    def steady_state(self, revolution: float = 0.0) -> Floats:
        """State ``[x, x', y, y']`` on the steady orbit without contact at a shaft angle."""
        turning = self.orbit_1x * cmath.exp(2j * math.pi * revolution)
        position, velocity = turning + self.rest, 1j * self.speed_ratio * turning
        return np.array([position.real, velocity.real, position.imag, velocity.imag])


@dataclass(frozen=True, slots=True)
class Change:
    """From shaft revolution ``at_rev`` on, the rotor has these ``parameters``."""

    at_rev: float
    parameters: PlantParameters


@dataclass(frozen=True, slots=True)
class Motion:
    """Where the disc was, sample by sample.

    Attributes:
        x: float64 ``[n]``, horizontal displacement in clearances.
        y: float64 ``[n]``, vertical displacement in clearances, upwards.
        revolution: float64 ``[n]``, shaft angle in revolutions since the start.
    """

    x: Floats
    y: Floats
    revolution: Floats

    def in_um(self, clearance_um: float) -> tuple[Floats, Floats]:
        """Displacements ``(x, y)`` in micrometres, for a radial clearance."""
        return self.x * clearance_um, self.y * clearance_um


def contact_force(
    x: float,
    vx: float,
    y: float,
    vy: float,
    stiffness: float,
    exponent: float,
    friction: float,
    rim_speed: float,
) -> tuple[float, float]:
    """Force of the housing on the disc, per mass and normalised; zero inside the clearance.

    Args:
        x: displacement in clearances, as ``y``.
        vx: velocity in clearances per 1/omega_s, as ``vy``.
        y: see ``x``.
        vy: see ``vx``.
        stiffness: K*.
        exponent: alpha.
        friction: mu.
        rim_speed: w R, the speed of the rim against the disc's centre.
    """
    r = math.hypot(x, y)
    if r <= 1.0:
        return 0.0, 0.0
    sliding_speed = rim_speed + (x * vy - y * vx) / r
    if sliding_speed == 0.0:
        friction = 0.0
    normal_over_r = stiffness * (r - 1.0) ** exponent / r
    drag = math.copysign(friction, sliding_speed)
    return -normal_over_r * (x - drag * y), -normal_over_r * (y + drag * x)


def state_derivative(tau: float, state: Sequence[float] | Floats, rotor: PlantParameters) -> Sequence[float]:
    """Right-hand side of the equations of motion.

    Args:
        tau: normalised time.
        state: ``[x, x', y, y']``.
        rotor: the operating condition.

    Raises:
        RotorEscapeError: the disc is farther out than `ESCAPE_RADIUS`.
    """
    return _derivative(tau, state, _coefficients(rotor))


def simulate(
    healthy: PlantParameters,
    changes: Sequence[Change] = (),
    *,
    revolutions: float,
    samples_per_rev: float = 64.0,
    process_noise: float = 0.0,
    rng: np.random.Generator | None = None,
    initial: Floats | None = None,
) -> Motion:
    """Run the rotor through a schedule of operating conditions, its state continuous throughout.

    Sample ``i`` is taken at shaft angle ``i / samples_per_rev`` revolutions.

    Args:
        healthy: condition at the start.
        changes: conditions that follow, by rising ``at_rev``; they need not fall on a sample.
        revolutions: length of the run.
        samples_per_rev: sampling rate over shaft speed; need not be whole.
        process_noise: two-sided power spectral density q of a white acceleration on either axis,
            normalised; acts as a velocity kick of variance ``q * dtau`` at every sample.
        rng: source of the process noise; needed if there is any.
        initial: state ``[x, x', y, y']`` at the start; the healthy steady orbit unless given.

    Raises:
        ValueError: the schedule is out of order, changes the shaft speed, or lacks an ``rng``.
        RotorEscapeError: the motion is not bounded.
    """
    _check_schedule(healthy, changes, revolutions, samples_per_rev, process_noise, rng)
    revolution = np.arange(math.ceil(revolutions * samples_per_rev)) / samples_per_rev
    tau_per_rev = 2 * math.pi / healthy.speed_ratio
    tau = revolution * tau_per_rev
    states = np.empty((len(tau), 4))
    kicks = None
    if process_noise > 0 and rng is not None:
        sigma = math.sqrt(process_noise * tau_per_rev / samples_per_rev)
        kicks = rng.normal(0.0, sigma, (len(tau), 2))

    state = healthy.steady_state() if initial is None else np.asarray(initial, dtype=np.float64)
    conditions = [Change(0.0, healthy), *changes]
    ends = [change.at_rev for change in changes] + [revolutions]
    for condition, end_rev in zip(conditions, ends, strict=True):
        begin, end = condition.at_rev * tau_per_rev, end_rev * tau_per_rev
        first, last = np.searchsorted(tau, (begin, end))
        instants = np.concatenate(([begin], tau[first:last], [end]))
        if kicks is None:
            course = _integrate(condition.parameters, instants, state)
        else:
            course = _integrate_kicked(condition.parameters, instants, state, kicks[first:last])
        states[first:last] = course[1:-1]
        state = course[-1]
    return Motion(x=states[:, 0].copy(), y=states[:, 2].copy(), revolution=revolution)


def _check_schedule(
    healthy: PlantParameters,
    changes: Sequence[Change],
    revolutions: float,
    samples_per_rev: float,
    process_noise: float,
    rng: np.random.Generator | None,
) -> None:
    times = [0.0, *(change.at_rev for change in changes), revolutions]
    if any(later <= earlier for earlier, later in itertools.pairwise(times)):
        raise ValueError(
            f"changes at revolutions {times[1:-1]} of a run of {revolutions} revolutions: "
            "they must rise, start after 0 and end before the run does"
        )
    for change in changes:
        if change.parameters.speed_ratio != healthy.speed_ratio:
            raise ValueError(
                f"the change at revolution {change.at_rev} sets speed_ratio to "
                f"{change.parameters.speed_ratio}; the shaft turns at {healthy.speed_ratio} throughout a run"
            )
    if samples_per_rev <= 2:
        raise ValueError(f"samples_per_rev is {samples_per_rev}; the 1X orbit needs more than 2")
    if process_noise < 0:
        raise ValueError(f"process_noise is {process_noise}; a power spectral density cannot be negative")
    if process_noise > 0 and rng is None:
        raise ValueError(f"process_noise is {process_noise} but there is no rng to draw it from")


def _coefficients(rotor: PlantParameters) -> Coefficients:
    return (
        2 * rotor.damping_ratio,
        rotor.stiffness,
        rotor.eccentricity * rotor.speed_ratio**2,
        rotor.speed_ratio,
        math.radians(rotor.heavy_spot_deg),
        rotor.side_load,
        -rotor.gravity - rotor.static_load,
        rotor.contact_stiffness,
        rotor.contact_exponent,
        rotor.friction,
        rotor.speed_ratio * rotor.disc_radius,
    )


def _derivative(tau: float, state: Sequence[float] | Floats, coefficients: Coefficients) -> Sequence[float]:
    two_zeta, k, unbalance, w, heavy_spot_rad, load_x, load_y, *contact = coefficients
    x, vx, y, vy = state
    if x * x + y * y > ESCAPE_RADIUS**2:
        raise RotorEscapeError(
            f"the rotor left its housing after {tau * w / (2 * math.pi):.2f} revolutions "
            f"(r > {ESCAPE_RADIUS:g} clearances) with damping_ratio={two_zeta / 2:g}, stiffness={k:g}, "
            f"eccentricity={unbalance / w**2:g}, contact_stiffness={contact[0]:g}, friction={contact[2]:g}: "
            "raise damping_ratio, or lower friction, contact_stiffness or the process noise"
        )
    angle = w * tau + heavy_spot_rad
    ax = unbalance * math.cos(angle) - two_zeta * vx - k * x + load_x
    ay = unbalance * math.sin(angle) - two_zeta * vy - k * y + load_y
    if x * x + y * y > 1.0:
        fx, fy = contact_force(x, vx, y, vy, *contact)
        ax += fx
        ay += fy
    return vx, ax, vy, ay


def _integrate(rotor: PlantParameters, instants: Floats, state: Floats) -> Floats:
    """States float64 ``[n, 4]`` at the ``instants`` (normalised times); ``state`` is that of the first."""
    course, report = odeint(
        _derivative,
        state,
        instants,
        args=(_coefficients(rotor),),
        tfirst=True,
        full_output=True,
        rtol=RELATIVE_TOLERANCE,
        atol=ABSOLUTE_TOLERANCE,
        mxstep=MAX_STEPS_PER_SAMPLE,
    )
    if report["message"] != "Integration successful.":
        raise ArithmeticError(
            f"the equations of motion could not be integrated with {rotor}: {report['message']} "
            "A lower contact_stiffness is easier to follow."
        )
    return np.asarray(course, dtype=np.float64)


def _integrate_kicked(rotor: PlantParameters, instants: Floats, state: Floats, kicks: Floats) -> Floats:
    """As `_integrate`, with a velocity kick float64 ``[n - 2, 2]`` at every instant but the two ends."""
    course = np.empty((len(instants), 4))
    course[0] = state
    for i in range(1, len(instants)):
        step = instants[i - 1 : i + 1]
        # A condition may begin on a sample: then its first step has no length.
        course[i] = _integrate(rotor, step, course[i - 1])[1] if step[1] > step[0] else course[i - 1]
        if i <= len(kicks):
            course[i, 1::2] += kicks[i - 1]
    return course


KEYPHASOR_REST_V = -10.0
KEYPHASOR_PULSE_V = -2.0
KEYPHASOR_WIDTH_REV = 1 / 16


def noise_sigma(amplitude: float, snr_db: float) -> float:
    """Standard deviation of the sensor noise at a signal-to-noise ratio.

    The ratio is that of the AC power of a harmonic, ``amplitude**2 / 2``, to the noise's variance in
    the whole band from 0 to half the sampling rate. Taken once, from the healthy orbit: sensors do
    not become noisier because the machine does.

    Args:
        amplitude: of the healthy 1X vibration in one channel, in any unit.
        snr_db: ratio in dB.

    Returns:
        The standard deviation in the unit of ``amplitude``.
    """
    return amplitude / math.sqrt(2.0) * math.pow(10.0, -snr_db / 20.0)


def keyphasor_voltage(revolution: Floats) -> Floats:
    """What a keyphasor probe sees of the mark on the shaft, in volts.

    One raised-cosine pulse a revolution, from -10 V up to -2 V, a sixteenth of a revolution wide. Its
    rising edge crosses the middle, -6 V, exactly at shaft angle zero, and is smooth enough for that
    crossing to be interpolated between samples.

    Args:
        revolution: float64 ``[n]``, shaft angle in revolutions.

    Returns:
        float64 ``[n]`` in volts.
    """
    # The pulse is half way up a quarter of its width before its top.
    from_top = np.mod(revolution - KEYPHASOR_WIDTH_REV / 4 + 0.5, 1.0) - 0.5
    height = 0.5 + 0.5 * np.cos(2 * np.pi * from_top / KEYPHASOR_WIDTH_REV)
    height[np.abs(from_top) > KEYPHASOR_WIDTH_REV / 2] = 0.0
    return KEYPHASOR_REST_V + (KEYPHASOR_PULSE_V - KEYPHASOR_REST_V) * height
