"""The Laval rotor with rub impact, in physical and in normalised quantities.

Source: the paper "Fault Detection and Diagnosis of Rotating Machinery", section II. Lengths are
normalised by the radial clearance c, time by the undamped natural frequency of the healthy shaft,
tau = omega_s t. With z = x + iy the motion is

    z'' + 2 zeta z' + k z = e w^2 exp(i (theta + phi)) + l_x - i g + f(z, z'),    theta' = w

The paper's static load acts along -y alone; here it has both components. Four statements of the paper
are wrong as printed and are corrected here:

* The contact force pushes the disc back: the state equation needs ``- gamma f(Cx)``, not ``+``. With
  the printed sign the disc is thrown out as soon as it touches.
* ``delta = r / c - 1`` with r the distance of the disc from the centre, not the disc's radius.
* ``g = G / (M c omega_s^2)``: G is a force, so the mass belongs under it.
* ``2 zeta = D_s / (M omega_s)`` with omega_s of the healthy shaft: damping does not scale with k.

A machine away from the paper's has two modes where the paper has one. Supports that are softer in one
direction, oil films and gyroscopic moments separate them (Genta, "Dynamics of Rotating Systems", 2005,
chapter 6). With the complex conjugate z* the motion is then

    z'' + (2 zeta - i gamma w) z' + d z*' + (k + i kappa) z + q z* = same right-hand side

which is the paper's rotor where the four further figures are 0; what higher modes add goes with the
unbalance and the square of the speed.

Coulomb friction opposes the slip at the point of contact, so its sign follows the velocity there.
The paper leaves that sign out; then friction drives a backward whirl without bound.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, kw_only=True)
class NormalisedRotor:
    """The rotor in units of clearance and of the healthy shaft's natural frequency.

    Attributes:
        w: speed over natural frequency; negative if the shaft turns clockwise (from +y to +x).
        e: mass eccentricity over clearance.
        zeta: damping ratio, D_s / (2 M omega_s).
        k: stiffness over the stiffness that omega_s was taken with.
        g: static load towards -y, G / (M c omega_s^2).
        load_x: static load towards +x, in the unit of ``g``.
        cross_stiffness: kappa, stiffness across the deflection, as an oil film has it.
        anisotropy: q, half the difference of the stiffnesses; its argument is twice the angle of the stiff
            direction.
        damping_anisotropy: d, the same of the damping.
        gyroscopic: gamma, gyroscopic moment over inertia.
        higher_modes: unbalance response of all higher modes over e w^2 exp(i phi), far below their own
            speeds.
        runout: part of the healthy motion that no mode explains, at rest, forward and backward, in
            clearances; it does not change with a fault.
        contact_stiffness: K* = K_beta / (M c omega_s^2).
        alpha: exponent of the contact force, 1 linear, 1.5 Hertz.
        mu: coefficient of Coulomb friction at the contact.
        heavy_spot_rad: angle phi of the heavy spot, from the keyphasor mark.
        contact_radius: radius of the rubbing surface over clearance; sets the slip velocity.
    """

    w: float
    e: float
    zeta: float
    k: float = 1.0
    g: float = 0.0
    contact_stiffness: float = 0.0
    alpha: float = 1.0
    mu: float = 0.0
    heavy_spot_rad: float = 0.0
    contact_radius: float = 250.0
    load_x: float = 0.0
    cross_stiffness: float = 0.0
    anisotropy: complex = 0j
    damping_anisotropy: complex = 0j
    gyroscopic: float = 0.0
    higher_modes: complex = 0j
    runout: tuple[complex, complex, complex] = (0j, 0j, 0j)

    def __post_init__(self) -> None:
        _require_positive("normalised rotor", zeta=self.zeta, k=self.k, contact_radius=self.contact_radius)
        _require_not_negative(
            "normalised rotor", e=self.e, contact_stiffness=self.contact_stiffness, mu=self.mu
        )
        _require_finite(
            "normalised rotor", w=self.w, g=self.g, load_x=self.load_x, heavy_spot_rad=self.heavy_spot_rad
        )
        if not 1.0 <= self.alpha <= 3.0:
            raise ValueError(f"normalised rotor: alpha is {self.alpha}; a contact has 1 <= alpha <= 3")

    @property
    def isotropic(self) -> bool:
        """Whether both axes move in the same way and independently: the paper's rotor."""
        return not (
            self.cross_stiffness
            or self.anisotropy
            or self.damping_anisotropy
            or self.gyroscopic
            or self.higher_modes
            or any(self.runout)
        )

    def orbit(self, w: float | None = None) -> complex:
        """Complex radius P of the steady orbit without contact, in clearances.

        z = P exp(i theta) + N exp(-i theta) + rest, with N = `backward_orbit`.

        Args:
            w: normalised speed; the rotor's own if not given.
        """
        speed = self.w if w is None else w
        forcing = self.e * speed**2 * cmath.exp(1j * self.heavy_spot_rad)
        forward = self.k - speed**2 + 2j * self.zeta * speed
        if self.isotropic:
            return forcing / forward
        return forcing * (self._compliances(speed)[0] + self.higher_modes) + self.runout[1]

    def backward_orbit(self, w: float | None = None) -> complex:
        """Complex radius N of the part of the steady orbit that turns against the shaft, in clearances.

        Args:
            w: normalised speed; the rotor's own if not given.
        """
        if self.isotropic:
            return 0j
        speed = self.w if w is None else w
        forcing = self.e * speed**2 * cmath.exp(1j * self.heavy_spot_rad)
        return (forcing * self._compliances(speed)[1]).conjugate() + self.runout[2]

    def _compliances(self, w: float) -> tuple[complex, complex]:
        """Radius P, and conjugate of N, of the orbit under a force 1 that turns with the shaft."""
        sprung, anisotropy = complex(self.k, self.cross_stiffness), self.anisotropy
        damping = complex(2.0 * self.zeta, -self.gyroscopic * w)
        forward = sprung - w**2 + 1j * w * damping
        backward = (sprung - w**2 - 1j * w * damping).conjugate()
        to_forward = anisotropy + 1j * w * self.damping_anisotropy
        to_backward = (anisotropy - 1j * w * self.damping_anisotropy).conjugate()
        p = 1.0 / (forward - to_forward * to_backward / backward)
        return p, -to_backward / backward * p

    @property
    def rest(self) -> complex:
        """Where the disc rests under its static load, in clearances."""
        load = complex(self.load_x, -self.g)
        if self.isotropic:
            return load / self.k
        sprung, q = complex(self.k, self.cross_stiffness), self.anisotropy
        sprung_rest = (sprung.conjugate() * load - q * load.conjugate()) / (abs(sprung) ** 2 - abs(q) ** 2)
        return sprung_rest + self.runout[0]

    def load_for(self, rest: complex) -> complex:
        """The static load, x + iy, under which the disc rests there, runout aside."""
        return complex(self.k, self.cross_stiffness) * rest + self.anisotropy * rest.conjugate()


class Film(NamedTuple):
    """Oil films that carry a shaft, over the healthy ones.

    Attributes:
        stiffness: along the deflection.
        damping: of the damping, and of the stiffness across the deflection, which comes of it.
        turned_rad: angle by which they have turned with what they carry.
    """

    stiffness: float = 1.0
    damping: float = 1.0
    turned_rad: float = 0.0


class Pedestal(NamedTuple):
    """What holds the supports, in series with their springs and dampers.

    Attributes:
        compliance: how much more it gives way, mean of both axes, over the static compliance of the rotor.
        anisotropy: compliance that came along x less that along y, over their sum.
    """

    compliance: float = 0.0
    anisotropy: float = 0.0


_FILM = 0.05
"""Above this stiffness across the deflection, over the static one, an oil film carries the shaft."""
SAME_FILM, SAME_PEDESTAL = Film(), Pedestal()


@dataclass(frozen=True, slots=True, kw_only=True)
class TwoModes:
    """What makes a rotor differ from a Laval rotor, as its run-up shows it.

    A shaft that is the same in all directions is in series with supports that need not be: springs with
    dampers beside them, both over the mean spring of the supports. Where the supports give way little, a
    damper that weakens also makes the machine softer, and a spring that weakens makes the damper move more.
    Both follow from the supports' part in the deflection.

    Attributes:
        support_share: beta, part of the static deflection that the supports take, 0 to 1; 1: a rigid shaft.
        support_lag: c over k of the supports, in 1 / omega_s.
        cross_stiffness: of the supports, across the deflection, as an oil film has it.
        anisotropy: half the difference of the supports' stiffnesses; its argument is twice the angle of the
            stiff direction.
        damping_anisotropy: the same of their damping, in 1 / omega_s.
        gyroscopic: gamma, gyroscopic moment over inertia.
        higher_modes: response of all higher modes; see `NormalisedRotor`.
        runout_um: part of 1X that no mode explains, forward and backward.
    """

    support_share: float
    support_lag: float
    cross_stiffness: float = 0.0
    anisotropy: complex = 0j
    damping_anisotropy: complex = 0j
    gyroscopic: float = 0.0
    higher_modes: complex = 0j
    runout_um: tuple[complex, complex] = (0j, 0j)

    @property
    def on_film(self) -> bool:
        """Whether the supports push so much across the deflection as only oil films do."""
        return abs(self.cross_stiffness) > _FILM

    def damping_ratio(self) -> float:
        """Damping ratio zeta, mean of both directions, at the natural frequency."""
        forward, *_, backward = self._stiffness(1.0, 1.0, 1.0)
        return (forward.imag + backward.imag) / 4.0

    def put_on(
        self,
        rotor: NormalisedRotor,
        *,
        damping_ratio: float = 1.0,
        stiffness_ratio: float = 1.0,
        film: Film = SAME_FILM,
        pedestal: Pedestal = SAME_PEDESTAL,
    ) -> NormalisedRotor:
        """A Laval rotor with these modes: what shaft and supports are together, at its speed.

        Args:
            rotor: speed, unbalance and contact are taken from it.
            damping_ratio: of the supports' dampers, over the healthy ones.
            stiffness_ratio: of the static stiffness, over the healthy one, by softer supports.
            film: what has become of the oil films that carry the shaft.
            pedestal: how much more what holds the supports gives way.
        """
        w = rotor.w
        forward, to_forward, to_backward, backward = self._stiffness(
            w, damping_ratio, stiffness_ratio, film, pedestal
        )
        stiffened = (forward.real - backward.real) / (2.0 * w**2)
        return replace(
            rotor,
            k=(forward.real + backward.real) / 2.0,
            zeta=(forward.imag + backward.imag) / (4.0 * w),
            cross_stiffness=(forward.imag - backward.imag) / 2.0,
            anisotropy=(to_forward + to_backward.conjugate()) / 2.0,
            damping_anisotropy=(to_forward - to_backward.conjugate()) / (2j * w),
            gyroscopic=self.gyroscopic + stiffened,
            higher_modes=self.higher_modes,
        )

    def compliance(self, w: float, order: int) -> Complexes:
        """Deflection that a force makes which turns at a multiple of the shaft speed, over the static one.

        Args:
            w: normalised speed of the shaft.
            order: the multiple; 0: a force that rests.

        Returns:
            complex128 ``[2, 2]``, from and to what turns forward and the conjugate of what turns backward.
        """
        speed = order * w
        forward, to_forward, to_backward, backward = self._stiffness(speed, 1.0, 1.0)
        inertia, gyroscopic = speed**2, self.gyroscopic * w * speed
        stiffness = np.array(
            [[forward - inertia + gyroscopic, to_forward], [to_backward, backward - inertia - gyroscopic]]
        )
        higher = self.higher_modes if order else 0j
        return np.asarray(np.linalg.inv(stiffness) + np.diag([higher, higher.conjugate()]))

    def alike_at(self, w: float, over_least: float) -> list[tuple[TwoModes, float]]:
        """Modes that answer the same at one speed, where the supports take another part of the deflection.

        A run-up shows the damping well, but hardly whether it is of stiff supports that lag far, or of soft
        ones that lag little. This decides how the whirl turns when a spring or a damper weakens.

        Args:
            w: normalised speed of the shaft.
            over_least: the other part over the least that makes as much damping, above 1.

        Returns:
            None, one or two, each with the square of its natural frequency over that of this rotor. Their
            springs and dampers push back in every direction.
        """
        lag = w * self.support_lag
        deflection = 1.0 - self.support_share + self.support_share / (1.0 + 1j * lag)
        lost = -deflection.imag / deflection.real
        support_share = over_least * 2.0 * lost * (math.hypot(1.0, lost) - lost)
        # lost = share lag / (1 + (1 - share) lag^2) has two solutions: damped more, supports move less.
        root = support_share**2 - 4.0 * lost**2 * (1.0 - support_share)
        if root < 0.0 or not 0.0 < support_share < 1.0:
            return []
        found = []
        for sign in (-1.0, 1.0):
            other = 2.0 * lost / (support_share - sign * math.sqrt(root))
            square = ((1.0 - support_share + support_share / (1.0 + 1j * other)) / deflection).real
            moved_more = (1.0 + 1j * other) / (1.0 + 1j * lag)
            turned = square * self.support_share / support_share * moved_more**2
            there = turned * (self.anisotropy + 1j * w * self.damping_anisotropy)
            back = (turned * (self.anisotropy - 1j * w * self.damping_anisotropy).conjugate()).conjugate()
            w_there = w / math.sqrt(square)
            modes = replace(
                self,
                support_share=support_share,
                support_lag=other / w_there,
                cross_stiffness=self.cross_stiffness * abs(turned),
                anisotropy=(there + back) / 2.0,
                damping_anisotropy=(there - back) / (2j * w_there),
                higher_modes=self.higher_modes * square,
            )
            if abs(modes.anisotropy) < 1.0 and abs(modes.damping_anisotropy) < modes.support_lag:
                found.append((modes, square))
        return found

    def _stiffness(
        self,
        w: float,
        damped: float,
        stiffness_ratio: float,
        film: Film = SAME_FILM,
        pedestal: Pedestal = SAME_PEDESTAL,
    ) -> tuple[complex, complex, complex, complex]:
        """Dynamic stiffness by rows, for forward and conjugate backward 1X, over the static one."""
        share = self.support_share
        spring = share / (1.0 / stiffness_ratio - 1.0 + share)
        damper = damped * film.damping
        turned = cmath.exp(2j * film.turned_rad)
        return series_stiffness(
            share,
            spring * complex(film.stiffness, film.damping * self.cross_stiffness),
            w * damper * self.support_lag,
            spring * film.stiffness * turned * self.anisotropy,
            w * damper * turned * self.damping_anisotropy,
            (1.0 - share + pedestal.compliance, pedestal.compliance * pedestal.anisotropy),
        )


def series_stiffness(
    share: Any,
    spring: Any,
    damper: Any,
    anisotropy: Any,
    damping_anisotropy: Any,
    shaft: tuple[Any, Any] | None = None,
) -> tuple[Any, Any, Any, Any]:
    """Dynamic stiffness of a shaft in series with its supports, over the static one of both.

    For amplitudes of exp(i theta), forward, and of the conjugate of what turns backward; also for arrays.

    Args:
        share: part of the static deflection that the supports take.
        spring: complex stiffness of the supports, over their own; imaginary: across the deflection.
        damper: w c / k of the supports.
        anisotropy: see `TwoModes`.
        damping_anisotropy: the same, times w.
        shaft: compliance of what is in series with the supports, and half the difference of its axes; None:
            that of a shaft which takes the rest of the deflection, the same in all directions.

    Returns:
        The four elements of the 2 x 2 matrix, row by row.
    """
    # Supports: what they push back with.
    a, b = spring + 1j * damper, anisotropy + 1j * damping_anisotropy
    c, d = anisotropy.conjugate() + 1j * damping_anisotropy.conjugate(), spring.conjugate() + 1j * damper
    held = share / (a * d - b * c)
    # Deflections in series add.
    mean, half = (1.0 - share, 0.0) if shaft is None else shaft
    a, b, c, d = mean + held * d, half - held * b, half - held * c, mean + held * a
    whole = 1.0 / (a * d - b * c)
    return whole * d, -whole * b, -whole * c, whole * a


@dataclass(frozen=True, slots=True, kw_only=True)
class RotorParameters:
    """The rotor as its maker or its commissioning describes it.

    Attributes:
        natural_frequency_hz: undamped natural frequency of the healthy shaft, omega_s / 2 pi.
        damping_ratio: zeta of the healthy shaft.
        eccentricity_um: distance of the centre of mass from the geometric centre.
        heavy_spot_deg: angle of the heavy spot from the keyphasor mark, anticlockwise.
        clearance_um: radial clearance c.
        static_sag_um: sag of the shaft under its weight, towards -y.
        contact_stiffness: K* = K_beta / (M c omega_s^2), dimensionless.
        hertz_exponent: alpha of the contact force.
        friction: Coulomb coefficient mu of the contact.
        contact_radius_um: radius of the rubbing surface.
        static_load_x_um: how far a static load bends the healthy shaft towards +x.
        two_modes: what makes it differ from a Laval rotor; None: it is one.
        plain_bearings: whether oil films carry the shaft; None: as its two modes show.
    """

    natural_frequency_hz: float
    damping_ratio: float
    eccentricity_um: float
    clearance_um: float
    heavy_spot_deg: float = 0.0
    static_sag_um: float = 0.0
    contact_stiffness: float = 30.0
    hertz_exponent: float = 1.0
    friction: float = 0.1
    contact_radius_um: float = 25_000.0
    static_load_x_um: float = 0.0
    two_modes: TwoModes | None = None
    plain_bearings: bool | None = None

    def __post_init__(self) -> None:
        _require_positive(
            "rotor",
            natural_frequency_hz=self.natural_frequency_hz,
            damping_ratio=self.damping_ratio,
            clearance_um=self.clearance_um,
            contact_radius_um=self.contact_radius_um,
        )

    @property
    def natural_frequency_rad_s(self) -> float:
        """The unit of normalised time: omega_s in rad/s."""
        return 2.0 * math.pi * self.natural_frequency_hz

    @property
    def on_film(self) -> bool:
        """Whether oil films carry the shaft, as stated, or else as its two modes show."""
        if self.plain_bearings is not None or self.two_modes is None:
            return bool(self.plain_bearings)
        return self.two_modes.on_film

    def normalised(self, speed_rpm: float, damping_ratio: float | None = None) -> NormalisedRotor:
        """The same rotor at a speed, in normalised quantities (paper, section II).

        Args:
            speed_rpm: speed of the shaft; negative if it turns clockwise.
            damping_ratio: damping of a faulty mode instead of the healthy one.

        Raises:
            ValueError: a quantity is outside what the model can mean.
        """
        return NormalisedRotor(
            w=speed_rpm / 60.0 / self.natural_frequency_hz,
            e=self.eccentricity_um / self.clearance_um,
            zeta=self.damping_ratio if damping_ratio is None else damping_ratio,
            k=1.0,
            g=self.static_sag_um / self.clearance_um,
            contact_stiffness=self.contact_stiffness,
            alpha=self.hertz_exponent,
            mu=self.friction,
            heavy_spot_rad=math.radians(self.heavy_spot_deg),
            contact_radius=self.contact_radius_um / self.clearance_um,
            load_x=self.static_load_x_um / self.clearance_um,
        )

    def faulty(
        self,
        speed_rpm: float,
        *,
        damping_ratio: float | None = None,
        unbalance_ratio: float = 1.0,
        stiffness_ratio: float = 1.0,
        static_load_um: complex = 0j,
        film: Film = SAME_FILM,
        pedestal: Pedestal = SAME_PEDESTAL,
    ) -> NormalisedRotor:
        """The rotor with a fault, at a speed, in normalised quantities.

        Args:
            speed_rpm: speed of the shaft; negative if it turns clockwise.
            damping_ratio: damping in place of the healthy one.
            unbalance_ratio: eccentricity over the healthy one.
            stiffness_ratio: static stiffness over the healthy one.
            static_load_um: additional load, as the sag of the healthy shaft under it, x + iy.
            film: what has become of the oil films, where there are two modes.
            pedestal: how much more what holds the supports gives way, where there are two modes.

        Raises:
            ValueError: a quantity is outside what the model can mean.
        """
        rotor = self.normalised(speed_rpm, damping_ratio)
        load = static_load_um / self.clearance_um
        if self.two_modes is None:
            return replace(
                rotor,
                e=rotor.e * unbalance_ratio,
                k=rotor.k * stiffness_ratio,
                load_x=rotor.load_x + load.real,
                g=rotor.g - load.imag,
            )
        forward, backward = self.two_modes.runout_um
        changed = replace(
            self.two_modes.put_on(
                rotor,
                damping_ratio=rotor.zeta / self.damping_ratio,
                stiffness_ratio=stiffness_ratio,
                film=film,
                pedestal=pedestal,
            ),
            e=rotor.e * unbalance_ratio,
            runout=(0j, forward / self.clearance_um, backward / self.clearance_um),
        )
        # Weight and load rest on the static stiffness, which dampers have no part in.
        rest = rotor.rest + load
        sunk = pedestal.compliance * (rest + pedestal.anisotropy * rest.conjugate())
        force = changed.load_for(rest / stiffness_ratio + sunk)
        return replace(changed, load_x=force.real, g=-force.imag)


def _require_positive(what: str, **values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{what}: {name} is {value}; it must be a finite number above 0")


def _require_not_negative(what: str, **values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value >= 0.0):
            raise ValueError(f"{what}: {name} is {value}; it must be a finite number, 0 or above")


def _require_finite(what: str, **values: float) -> None:
    for name, value in values.items():
        if not math.isfinite(value):
            raise ValueError(f"{what}: {name} is {value}; it must be a finite number")
