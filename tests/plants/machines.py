"""Rotors by finite elements that share no arithmetic with the product's model (`ross-rotordynamics`).

Each is reduced to the few shapes that matter: its lowest modes, and how it bends under a force where
anything acts on it. What is left is `M q" + (C + Omega G) q' + K q = f`.

Runs in an environment of its own (`requirements-plants.txt`); nothing here imports the product.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    import ross

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

GRAVITY_M_S2 = 9.80665
_STEEL_KG_M3, _STEEL_PA, _STEEL_SHEAR_PA = 7810.0, 211e9, 81.2e9
_MODES = 10
_KEPT = (0, 1, 3, 4)
"""Of the six degrees of freedom of a node those that bend the shaft; it neither stretches nor twists here."""
_COARSE_RAD_S, _FINE = 12.0, 0.02
"""Steps that the first critical speed is sought with: rad/s, and then in parts of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Journal:
    """A plain bearing with an oil film, short-bearing theory.

    Attributes:
        length_m: of the bearing.
        diameter_m: of the journal.
        clearance_m: radial.
        viscosity_pa_s: of the oil.
    """

    length_m: float
    diameter_m: float
    clearance_m: float
    viscosity_pa_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Support:
    """What carries the shaft at one node: a spring or an oil film, on a pedestal if there is one.

    Attributes:
        node: of the shaft.
        stiffness_n_m: in x and y; of the oil film, if there is one, nothing.
        damping_n_s_m: in x and y.
        journal: the oil film.
        pedestal_stiffness_n_m: in x and y; None: rigid ground.
        pedestal_mass_kg: of the part that moves.
        pedestal_damping_n_s_m: in x and y.
    """

    node: int
    stiffness_n_m: tuple[float, float] = (0.0, 0.0)
    damping_n_s_m: tuple[float, float] = (0.0, 0.0)
    journal: Journal | None = None
    pedestal_stiffness_n_m: tuple[float, float] | None = None
    pedestal_mass_kg: float = 0.0
    pedestal_damping_n_s_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Geometry:
    """A rotor as a workshop drawing has it.

    Attributes:
        name: of the geometry.
        part: of the bench that it belongs to: ``tuned``, ``set aside`` or ``drawn``.
        shaft: length and diameter of each element, m.
        discs: node, width and diameter of each, m.
        supports: what carries it.
        probes: node that the proximity probes look at.
        rub: node that has the least clearance.
        coupling: node at the driven end.
        cracked: element that a crack would be in.
        unbalance_um: residual eccentricity of each disc, um, and its angle, rad.
        of_speeds: speeds, in parts of the first critical speed.
    """

    name: str
    part: str
    shaft: tuple[tuple[float, float], ...]
    discs: tuple[tuple[int, float, float], ...]
    supports: tuple[Support, ...]
    probes: int
    rub: int
    coupling: int
    cracked: int
    unbalance_um: tuple[tuple[float, float], ...]
    of_speeds: tuple[float, ...] = (0.7, 1.0, 1.35)

    @property
    def disc_masses_kg(self) -> tuple[float, ...]:
        """Of the discs, less the hole for the shaft."""
        area = ((width, np.pi / 4.0 * (d**2 - self.shaft[0][1] ** 2)) for _, width, d in self.discs)
        return tuple(_STEEL_KG_M3 * width * square for width, square in area)


def _even(length_m: float, count: int, diameter_m: float) -> tuple[tuple[float, float], ...]:
    return ((length_m / count, diameter_m),) * count


def _spring(node: int, x: float, y: float, damping: float) -> Support:
    return Support(node=node, stiffness_n_m=(x, y), damping_n_s_m=(damping, damping * np.sqrt(y / x)))


GEOMETRIES = (
    Geometry(
        name="between bearings",
        part="tuned",
        shaft=_even(0.6, 8, 0.03),
        discs=((4, 0.05, 0.20),),
        supports=(_spring(0, 6e6, 6e6, 1.6e4), _spring(8, 6e6, 6e6, 1.6e4)),
        probes=4,
        rub=4,
        coupling=0,
        cracked=3,
        unbalance_um=((25.0, 0.3),),
    ),
    Geometry(
        name="overhung",
        part="tuned",
        shaft=_even(0.7, 10, 0.04),
        discs=((10, 0.04, 0.24),),
        supports=(_spring(1, 1.5e7, 1.5e7, 1.5e4), _spring(6, 8e6, 8e6, 1.8e4)),
        probes=9,
        rub=10,
        coupling=0,
        cracked=7,
        unbalance_um=((20.0, 1.0),),
    ),
    Geometry(
        name="journals on pedestals",
        part="tuned",
        shaft=_even(1.2, 12, 0.06),
        discs=((4, 0.05, 0.30), (8, 0.05, 0.30)),
        supports=tuple(
            Support(
                node=node,
                journal=Journal(length_m=0.03, diameter_m=0.06, clearance_m=9e-5, viscosity_pa_s=0.03),
                pedestal_stiffness_n_m=(4e7, 7e7),
                pedestal_mass_kg=12.0,
                pedestal_damping_n_s_m=(3e3, 4e3),
            )
            for node in (0, 12)
        ),
        probes=4,
        rub=6,
        coupling=0,
        cracked=5,
        unbalance_um=((15.0, 0.2), (10.0, 1.6)),
    ),
    Geometry(
        name="anisotropic supports",
        part="tuned",
        shaft=_even(0.8, 8, 0.035),
        discs=((3, 0.05, 0.22),),
        supports=(_spring(0, 4e6, 7e6, 1e4), _spring(8, 4e6, 7e6, 1e4)),
        probes=3,
        rub=3,
        coupling=8,
        cracked=4,
        unbalance_um=((25.0, 2.0),),
    ),
    Geometry(
        name="off centre",
        part="set aside",
        shaft=_even(0.7, 10, 0.032),
        discs=((3, 0.04, 0.22),),
        supports=(_spring(0, 7e6, 7e6, 1.5e4), _spring(10, 4e6, 4e6, 1.2e4)),
        probes=4,
        rub=3,
        coupling=10,
        cracked=5,
        unbalance_um=((22.0, 4.0),),
    ),
    Geometry(
        name="two discs",
        part="set aside",
        shaft=_even(0.9, 12, 0.04),
        discs=((4, 0.05, 0.24), (9, 0.03, 0.20)),
        supports=(_spring(0, 8e6, 8e6, 1.6e4), _spring(12, 8e6, 8e6, 1.6e4)),
        probes=5,
        rub=4,
        coupling=0,
        cracked=6,
        unbalance_um=((18.0, 0.0), (12.0, 2.5)),
    ),
    Geometry(
        name="long rotor on journals",
        part="set aside",
        shaft=_even(1.6, 16, 0.075),
        discs=((5, 0.06, 0.32), (8, 0.06, 0.36), (11, 0.06, 0.32)),
        supports=tuple(
            Support(
                node=node,
                journal=Journal(length_m=0.04, diameter_m=0.075, clearance_m=1.1e-4, viscosity_pa_s=0.025),
                pedestal_stiffness_n_m=(8e7, 1.2e8),
                pedestal_mass_kg=25.0,
                pedestal_damping_n_s_m=(6e3, 8e3),
            )
            for node in (0, 16)
        ),
        probes=7,
        rub=8,
        coupling=16,
        cracked=7,
        unbalance_um=((12.0, 0.2), (8.0, 2.0), (10.0, 3.5)),
    ),
    Geometry(
        name="overhung on soft supports",
        part="set aside",
        shaft=_even(0.8, 10, 0.045),
        discs=((10, 0.05, 0.26), (4, 0.03, 0.18)),
        supports=(_spring(0, 1.5e7, 2.2e7, 1.5e4), _spring(7, 8e6, 1.2e7, 2e4)),
        probes=9,
        rub=10,
        coupling=0,
        cracked=8,
        unbalance_um=((16.0, 1.2), (8.0, 4.4)),
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """What differs from the drawing.

    Attributes:
        damping: of all springs' dampers, in parts.
        stiffness: of each support's spring, in parts, in the order of the supports.
        pedestal: of each pedestal's spring, in parts.
        clearance: of all oil films, in parts.
        viscosity: likewise.
        load_weight: static load at the node that rubs, in parts of the rotor's weight.
        load_angle_rad: its direction.
    """

    damping: float = 1.0
    stiffness: tuple[float, ...] = ()
    pedestal: tuple[float, ...] = ()
    clearance: float = 1.0
    viscosity: float = 1.0
    load_weight: float = 0.0
    load_angle_rad: float = -np.pi / 2.0


@dataclass(frozen=True, slots=True)
class Machine:
    """A reduced rotor in one condition, at one speed.

    Attributes:
        mass: float64 ``[n, n]``.
        damping: float64 ``[n, n]``, C + Omega G.
        stiffness: float64 ``[n, n]``.
        rest: float64 ``[n]``, where it stands under its weight and load, oil films included, as nearly as the
            shapes reach.
        places: float64 ``[n]`` rows by name: ``x`` and ``y`` of probes, rub and coupling, and of the bend
            of the cracked element; ``x`` and ``y`` of each disc and each support.
        bending_n_m: bending stiffness of the cracked element, E I / L.
        weight_n: of the rotor.
        disc_masses_kg: of the discs.
    """

    mass: Floats
    damping: Floats
    stiffness: Floats
    rest: Floats
    places: dict[str, Floats]
    bending_n_m: float
    weight_n: float
    disc_masses_kg: tuple[float, ...]


def _film(
    support: Support, condition: Condition, speed_rad_s: float, load_n: float
) -> ross.CylindricalBearing:
    assert support.journal is not None
    film = support.journal
    return ross.CylindricalBearing(
        n=support.node,
        speed=np.array([speed_rad_s]),
        weight=load_n,
        bearing_length=film.length_m,
        journal_diameter=film.diameter_m,
        radial_clearance=film.clearance_m * condition.clearance,
        oil_viscosity=film.viscosity_pa_s * condition.viscosity,
    )


class Model:
    """A geometry in finite elements; conditions and speeds of it share their shapes."""

    def __init__(self, geometry: Geometry) -> None:
        self.geometry = geometry
        self._steel = ross.Material("steel", rho=_STEEL_KG_M3, E=_STEEL_PA, G_s=_STEEL_SHEAR_PA)
        self._basis: Floats | None = None

    def _rotor(self, condition: Condition, speed_rad_s: float, loads: Sequence[float]) -> ross.Rotor:
        g = self.geometry
        shaft = [
            ross.ShaftElement(length, 0.0, diameter, material=self._steel) for length, diameter in g.shaft
        ]
        discs = [
            ross.DiskElement.from_geometry(n=n, material=self._steel, width=w, i_d=g.shaft[0][1], o_d=d)
            for n, w, d in g.discs
        ]
        elements, masses, free = [], [], len(g.shaft) + 1
        for i, support in enumerate(g.supports):
            softer = condition.stiffness[i] if condition.stiffness else 1.0
            kx, ky = (softer * k for k in support.stiffness_n_m)
            cx, cy = (condition.damping * c for c in support.damping_n_s_m)
            coefficients = {"kxx": kx, "kyy": ky, "cxx": cx, "cyy": cy}
            if support.journal is not None:
                film = _film(support, condition, speed_rad_s, loads[i])
                names = ("kxx", "kxy", "kyx", "kyy", "cxx", "cxy", "cyx", "cyy")
                coefficients = {name: float(getattr(film, name)[0]) for name in names}
            if support.pedestal_stiffness_n_m is None:
                elements.append(ross.BearingElement(n=support.node, **coefficients))
                continue
            part = condition.pedestal[i] if condition.pedestal else 1.0
            kx, ky = (part * k for k in support.pedestal_stiffness_n_m)
            cx, cy = support.pedestal_damping_n_s_m
            elements.append(ross.BearingElement(n=support.node, n_link=free, **coefficients))
            elements.append(ross.BearingElement(n=free, kxx=kx, kyy=ky, cxx=cx, cyy=cy))
            masses.append(ross.PointMass(n=free, m=support.pedestal_mass_kg))
            free += 1
        return ross.Rotor(shaft, discs, elements, masses)

    def _loads(self, condition: Condition) -> tuple[list[float], list[float]]:
        """Force on each of two supports, and the angle it makes with down, by the law of the lever."""
        g = self.geometry
        places = np.concatenate(([0.0], np.cumsum([length for length, _ in g.shaft])))
        masses = np.zeros(len(places))
        for i, (length, diameter) in enumerate(g.shaft):
            masses[i : i + 2] += _STEEL_KG_M3 * np.pi / 8.0 * diameter**2 * length
        for (n, _, _), mass in zip(g.discs, g.disc_masses_kg, strict=True):
            masses[n] += mass
        force = -1j * GRAVITY_M_S2 * masses
        weight = GRAVITY_M_S2 * float(masses.sum())
        force[g.rub] += condition.load_weight * weight * np.exp(1j * condition.load_angle_rad)
        a, b = (places[support.node] for support in g.supports)
        second = complex((force * (places - a)).sum() / (b - a))
        first = complex(force.sum()) - second
        return [abs(first), abs(second)], [float(np.angle(f) + np.pi / 2.0) for f in (first, second)]

    def machine(self, condition: Condition, speed_rad_s: float) -> Machine:
        """The reduced rotor.

        Args:
            condition: what differs from the drawing.
            speed_rad_s: shaft speed.
        """
        g = self.geometry
        loads, angles = self._loads(condition)
        rotor = self._rotor(condition, speed_rad_s, loads)
        # A node of the shaft has six degrees of freedom, a pedestal three: it does not tilt.
        nodes = len(g.shaft) + 1
        kept = np.array(
            [6 * node + i for node in range(nodes) for i in _KEPT]
            + [d for d in range(6 * nodes, rotor.ndof) if (d - 6 * nodes) % 3 < 2]
        )
        full = [
            np.asarray(m)[np.ix_(kept, kept)]
            for m in (rotor.M(), rotor.K(speed_rad_s), rotor.C(speed_rad_s), rotor.G())
        ]
        mass, stiffness, damping, gyroscopic = full
        where = {int(d): i for i, d in enumerate(kept)}

        def unit(node: int, axis: int) -> Floats:
            row = np.zeros(len(kept))
            row[where[(6 * node if node < nodes else 6 * nodes + 3 * (node - nodes)) + axis]] = 1.0
            return row

        places = {}
        for name, node in (("probe", g.probes), ("rub", g.rub), ("coupling", g.coupling)):
            places |= {f"{name} x": unit(node, 0), f"{name} y": unit(node, 1)}
        for i, (node, _, _) in enumerate(g.discs):
            places |= {f"disc {i} x": unit(node, 0), f"disc {i} y": unit(node, 1)}
        free = nodes
        for i, support in enumerate(g.supports):
            x, y = unit(support.node, 0), unit(support.node, 1)
            if support.pedestal_stiffness_n_m is not None:
                x, y = x - unit(free, 0), y - unit(free, 1)
                places |= {f"pedestal {i} x": unit(free, 0), f"pedestal {i} y": unit(free, 1)}
                free += 1
            places |= {f"support {i} x": x, f"support {i} y": y}
        # Slope about y is dx/dz, that about x is -dy/dz.
        e = g.cracked
        places["bend x"] = unit(e + 1, 4) - unit(e, 4)
        places["bend y"] = unit(e, 3) - unit(e + 1, 3)
        places["tilt x"], places["tilt y"] = unit(g.coupling, 4), -unit(g.coupling, 3)

        down = np.zeros(len(kept))
        down[[i for d, i in where.items() if (d % 6 if d < 6 * nodes else (d - 6 * nodes) % 3) == 1]] = 1.0
        force = -GRAVITY_M_S2 * mass @ down
        on_shaft = np.arange(len(kept)) < len(_KEPT) * nodes
        rotor_weight = -float((force * down * on_shaft).sum())
        load = condition.load_weight * rotor_weight * np.exp(1j * condition.load_angle_rad)
        force = force + load.real * places["rub x"] + load.imag * places["rub y"]
        # An oil film carries its load where it stands: only what moves it from there is force of a spring.
        for i, support in enumerate(g.supports):
            if support.journal is None:
                continue
            film = _film(support, condition, speed_rad_s, loads[i])
            eccentricity = (
                float(np.ravel(film.eccentricity)[0]) * support.journal.clearance_m * condition.clearance
            )
            stands = eccentricity * np.exp(
                1j * (float(np.ravel(film.attitude_angle)[0]) - np.pi / 2.0 + angles[i])
            )
            x, y = places[f"support {i} x"], places[f"support {i} y"]
            k = np.array([[film.kxx[0], film.kxy[0]], [film.kyx[0], film.kyy[0]]])
            carries = loads[i] * np.exp(1j * (angles[i] + np.pi / 2.0))
            held = k @ np.array([stands.real, stands.imag])
            force = force + (held[0] + carries.real) * x + (held[1] + carries.imag) * y
        rest = np.linalg.solve(stiffness, force)

        basis = self._shapes(mass, stiffness, places)
        shape = np.linalg.lstsq(basis, rest, rcond=None)[0]
        reduced = [basis.T @ m @ basis for m in (mass, damping + speed_rad_s * gyroscopic, stiffness)]
        element_m, diameter_m = g.shaft[e]
        return Machine(
            *reduced,
            rest=shape,
            places={name: row @ basis for name, row in places.items()},
            bending_n_m=_STEEL_PA * np.pi / 64.0 * diameter_m**4 / element_m,
            weight_n=rotor_weight,
            disc_masses_kg=g.disc_masses_kg,
        )

    def _shapes(self, mass: Floats, stiffness: Floats, places: dict[str, Floats]) -> Floats:
        """Shapes that all conditions are reduced to: those of the first condition asked for."""
        if self._basis is None:
            even = (stiffness + stiffness.T) / 2.0
            _, modes = scipy.linalg.eigh(even, mass)
            bent = np.linalg.solve(even, np.stack(list(places.values()), axis=1))
            candidates = np.hstack((modes[:, :_MODES], bent / np.linalg.norm(bent, axis=0)))
            left, size, _ = np.linalg.svd(
                candidates / np.linalg.norm(candidates, axis=0), full_matrices=False
            )
            basis = left[:, size > 1e-6 * size[0]]
            # Without a scale of their own the shapes make badly conditioned matrices.
            small = basis.T @ mass @ basis
            self._basis = np.asarray(basis @ np.linalg.inv(np.linalg.cholesky(small)).T)
        return self._basis

    def first_critical(self) -> tuple[float, float]:
        """Speed of the largest forward 1X by unbalance, rad/s, and damping ratio by that peak's width."""

        def size(speed_rad_s: float) -> float:
            machine = self.machine(Condition(), speed_rad_s)
            return abs(forward(machine, self.geometry, speed_rad_s)) / speed_rad_s**2

        speed, before, here = 5.0 * _COARSE_RAD_S, 0.0, 0.0
        while here >= before:
            speed, before, here = speed + _COARSE_RAD_S, here, size(speed + _COARSE_RAD_S)
        near = (speed - _COARSE_RAD_S) * np.linspace(1.0 - 10 * _FINE, 1.0 + 10 * _FINE, 21)
        sizes = np.array([size(float(s)) for s in near])
        top = int(sizes.argmax())
        half = sizes[top] / np.sqrt(2.0)
        low = float(np.interp(half, sizes[: top + 1], near[: top + 1]))
        high = float(np.interp(-half, -sizes[top:], near[top:]))
        return float(near[top]), (high - low) / (2.0 * float(near[top]))


def unbalance_force(machine: Machine, geometry: Geometry, speed_rad_s: float) -> NDArray[np.complex128]:
    """Force of the residual unbalance on the shapes, complex128 ``[n]``: its real part turns forward."""
    force = np.zeros(len(machine.mass), dtype=np.complex128)
    for i, (eccentric_um, angle) in enumerate(geometry.unbalance_um):
        size = machine.disc_masses_kg[i] * eccentric_um * 1e-6 * speed_rad_s**2 * np.exp(1j * angle)
        force += size * (machine.places[f"disc {i} x"] - 1j * machine.places[f"disc {i} y"])
    return force


def forward(machine: Machine, geometry: Geometry, speed_rad_s: float) -> complex:
    """Forward 1X at the probes by the residual unbalance, m."""
    force = unbalance_force(machine, geometry, speed_rad_s)
    dynamic = machine.stiffness - speed_rad_s**2 * machine.mass + 1j * speed_rad_s * machine.damping
    q = np.linalg.solve(dynamic, force)
    x, y = machine.places["probe x"] @ q, machine.places["probe y"] @ q
    return complex((x + 1j * y) / 2.0)


def stable(machine: Machine) -> bool:
    """Whether all modes are damped."""
    n = len(machine.mass)
    state = np.block(
        [
            [np.zeros((n, n)), np.eye(n)],
            [
                -np.linalg.solve(machine.mass, machine.stiffness),
                -np.linalg.solve(machine.mass, machine.damping),
            ],
        ]
    )
    return bool(np.linalg.eigvals(state).real.max() < 0.0)
