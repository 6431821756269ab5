"""The Laval rotor with rub impact, in physical and in normalised quantities.

Source: the paper "Fault Detection and Diagnosis of Rotating Machinery", section II. Lengths are
normalised by the radial clearance c, time by the undamped natural frequency of the healthy shaft,
tau = omega_s t. With z = x + iy the motion is

    z'' + 2 zeta z' + k z = e w^2 exp(i (theta + phi)) + l_x - i g + f(z, z'),    theta' = w

The paper's static load acts along -y alone; here it has both components. Four statements of the paper
cannot stand as printed and are corrected here:

* The contact force pushes the disc back: the state equation needs ``- gamma f(Cx)``, not ``+``. With
  the printed sign the disc is thrown out as soon as it touches.
* ``delta = r / c - 1`` with r the distance of the disc from the centre, not the disc's radius.
* ``g = G / (M c omega_s^2)``: G is a force, so the mass belongs under it.
* ``2 zeta = D_s / (M omega_s)`` with omega_s of the healthy shaft: damping does not scale with k.

Coulomb friction opposes the slip at the point of contact, so its sign follows the velocity there.
The paper leaves that sign out; then a backward whirl feeds on the friction without bound.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass


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

    def orbit(self, w: float | None = None) -> complex:
        """Complex radius P of the steady orbit without contact, z = P exp(i theta) + rest, in clearances.

        Args:
            w: normalised speed; the rotor's own if not given.
        """
        speed = self.w if w is None else w
        forcing = self.e * speed**2 * cmath.exp(1j * self.heavy_spot_rad)
        return forcing / (self.k - speed**2 + 2j * self.zeta * speed)

    @property
    def rest(self) -> complex:
        """Where the disc rests under its static load, in clearances."""
        return complex(self.load_x, -self.g) / self.k


@dataclass(frozen=True, slots=True, kw_only=True)
class RotorParameters:
    """The rotor as its maker or its commissioning describes it.

    Attributes:
        natural_frequency_hz: undamped natural frequency of the healthy shaft, omega_s / 2 pi.
        damping_ratio: zeta of the healthy shaft.
        eccentricity_um: distance of the centre of mass from the geometric centre.
        heavy_spot_deg: angle of the heavy spot from the keyphasor mark, against the clock.
        clearance_um: radial clearance c.
        static_sag_um: sag of the shaft under its weight, towards -y.
        contact_stiffness: K* = K_beta / (M c omega_s^2), dimensionless.
        hertz_exponent: alpha of the contact force.
        friction: Coulomb coefficient mu of the contact.
        contact_radius_um: radius of the rubbing surface.
        static_load_x_um: how far a static load bends the healthy shaft towards +x.
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
