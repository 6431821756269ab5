"""A rolling element bearing between rotor and housing, with faults on its races or its balls.

Three masses in a line by their mass, damping and stiffness matrices. The motion is exact. Every run is
periodic, and its spectrum is the dynamic stiffness's answer to the spectrum of its excitation, up to half
the sampling rate (the range of an accelerometer's anti-aliasing filter). Nothing here is shared with the
detectors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]
    Fault = Literal["healthy", "inner", "outer", "ball", "inner_and_outer"]

OVERSAMPLING = 4
"""The pulses are drawn on so much finer a grid: their edges are broader than a sample is long."""
ORDERS = {"outer": 3.5848, "inner": 5.4152, "ball": 4.7135, "cage": 0.3983}
"""Passing frequencies of a 6205 in shaft orders; the ball's is twice its spin: it meets both races."""
BALL_DEPTH = 1.6
"""Of a ball's dip over a race's. It meets either race at half the rate and is loaded for a third of the time;
at this depth it shakes the machine as much as a fault of a race does."""
RUN_IN_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingMachine:
    """A machine with one bearing, in SI units.

    Attributes:
        masses: of rotor, rolling elements and housing in kg.
        stiffnesses: of shaft, contact and housing in N/m.
        dampings: of shaft, contact and housing in N s/m.
    """

    masses: tuple[float, float, float]
    stiffnesses: tuple[float, float, float]
    dampings: tuple[float, float, float]

    def mismatched(self, share: float, rng: np.random.Generator) -> BearingMachine:
        """Another machine of the kind: every figure off by up to a share of it, uniformly."""

        def off(figures: tuple[float, float, float]) -> tuple[float, float, float]:
            first, second, third = (1.0 + share * rng.uniform(-1.0, 1.0, 3)) * figures
            return float(first), float(second), float(third)

        return BearingMachine(
            masses=off(self.masses), stiffnesses=off(self.stiffnesses), dampings=off(self.dampings)
        )

    def accelerance(self, frequency_hz: Floats) -> NDArray[np.complex128]:
        """Accelerations of rotor and housing: complex128 ``[n, 2, 3]`` to u_in, u_out (m) and v (N)."""
        w = 2.0 * np.pi * np.asarray(frequency_hz, dtype=np.float64)
        (k1, k2, k3), (c1, c2, c3), (m1, m2, m3) = self.stiffnesses, self.dampings, self.masses
        z1, z2, z3 = (k + 1j * w * c for k, c in ((k1, c1), (k2, c2), (k3, c3)))
        dynamic = np.zeros((len(w), 3, 3), dtype=np.complex128)
        dynamic[:, 0, 0] = z1 - m1 * w**2
        dynamic[:, 1, 1] = z1 + z2 - m2 * w**2
        dynamic[:, 2, 2] = z2 + z3 - m3 * w**2
        dynamic[:, 0, 1] = dynamic[:, 1, 0] = -z1
        dynamic[:, 1, 2] = dynamic[:, 2, 1] = -z2
        forces = np.array([[k1, 0.0, 1.0], [-k1, -k2, 0.0], [0.0, k2, 0.0]], dtype=np.complex128)
        motion = np.linalg.solve(dynamic, forces)
        return np.asarray(-(w[:, None, None] ** 2) * motion[:, [0, 2]])


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultSignal:
    """How the defects beat.

    Attributes:
        shaft_hz: shaft speed.
        pulse_s: length of the cosine-shaped dip as a rolling element passes a spall.
        depth_m: of the dip under full load.
        slip: mean share by which the rolling elements lag behind the kinematics; each event is late at random
            by as much again.
        load_zone: epsilon of Sjovall's load distribution; 0.5 loads half of the ring.
    """

    shaft_hz: float = 29.95
    pulse_s: float = 0.34e-3
    depth_m: float = 2e-6
    slip: float = 0.015
    load_zone: float = 0.4

    def displacements(self, fault: Fault, t_s: Floats, rng: np.random.Generator) -> Floats:
        """Displacement of inner and outer race.

        Args:
            fault: what is damaged.
            t_s: float64 ``[n]``, evenly spaced.
            rng: of phases and slip.

        Returns:
            float64 ``[2, n]`` in m.
        """
        u = np.zeros((2, len(t_s)))
        if fault in {"inner", "inner_and_outer"}:
            # The spall turns with the shaft through the load zone.
            events = self._events("inner", t_s, rng)
            angle = 2.0 * np.pi * (self.shaft_hz * events + rng.uniform())
            u[0] += self._dips(events, self._load(angle), t_s)
        if fault in {"outer", "inner_and_outer"}:
            events = self._events("outer", t_s, rng)
            u[1] += self._dips(events, np.ones(len(events)), t_s)
        if fault == "ball":
            events = self._events("ball", t_s, rng)
            angle = 2.0 * np.pi * (ORDERS["cage"] * self.shaft_hz * events + rng.uniform())
            load = BALL_DEPTH * self._load(angle)
            for race in (0, 1):
                u[race] += self._dips(events[race::2], load[race::2], t_s)
        return u

    def _events(self, which: str, t_s: Floats, rng: np.random.Generator) -> Floats:
        period = (1.0 + self.slip) / (ORDERS[which] * self.shaft_hz)
        count = math.ceil((t_s[-1] - t_s[0]) / period) + 1
        gaps = period * (1.0 + self.slip * rng.standard_normal(count))
        return np.asarray(t_s[0] + period * rng.uniform() + np.cumsum(gaps) - gaps[0])

    def _load(self, angle: Floats) -> Floats:
        share = 1.0 - (1.0 - np.cos(angle)) / (2.0 * self.load_zone)
        return np.asarray(np.maximum(share, 0.0) ** 1.5)

    def _dips(self, events: Floats, depths: Floats, t_s: Floats) -> Floats:
        step = t_s[1] - t_s[0]
        width = math.ceil(self.pulse_s / step) + 1
        at = np.floor((events - t_s[0]) / step).astype(np.int64)[:, None] + np.arange(1, width + 1)
        from_start = at * step + t_s[0] - events[:, None]
        bell = 0.5 - 0.5 * np.cos(2.0 * np.pi * from_start / self.pulse_s)
        dips = -depths[:, None] * self.depth_m * bell
        dips[(from_start < 0.0) | (from_start > self.pulse_s)] = 0.0
        u = np.zeros(len(t_s))
        inside = at < len(t_s)
        np.add.at(u, at[inside], dips[inside])
        return u


@dataclass(frozen=True, slots=True)
class BearingRun:
    """What the sensors of a machine measured.

    Attributes:
        y: float64 ``[n, 2]``, accelerations of rotor and housing in m/s^2.
        v: float64 ``[n]``, force of the unbalance on the rotor in N, as known from balancing.
    """

    y: Floats
    v: Floats


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """What noise and unbalance of a machine are, fixed while its faults come and go.

    Attributes:
        noise: standard deviation of the white noise of either sensor in m/s^2.
        unbalance_n: amplitude of the unbalance force in N.
    """

    noise: tuple[float, float]
    unbalance_n: float


def levels(
    machine: BearingMachine,
    signal: FaultSignal,
    *,
    snr_db: float,
    rate_hz: float = 48_000.0,
    unbalance_ratio: float = 3.0,
    seed: int = 0,
) -> NoiseLevels:
    """Noise and unbalance of a machine.

    Args:
        machine: the machine.
        signal: how its faults beat.
        snr_db: power of an inner and an outer fault, on average, over the noise's in a sensor's whole band.
        rate_hz: sampling rate.
        unbalance_ratio: 1X of the rotor's sensor over the rms value that the faults have there.
        seed: of the faults that are measured.
    """
    rng = np.random.default_rng(seed)
    power = np.zeros(2)
    faults: tuple[Fault, ...] = ("inner", "outer")
    for fault in faults:
        quiet = simulate(machine, signal, fault, NoiseLevels((0.0, 0.0), 0.0), rng, rate_hz=rate_hz)
        power += np.square(quiet.y).mean(axis=0) / 2.0
    noise = np.sqrt(power) * 10.0 ** (-snr_db / 20.0)
    at_1x = np.abs(machine.accelerance(np.array([signal.shaft_hz]))[0, 0, 2]) / math.sqrt(2.0)
    return NoiseLevels(
        (float(noise[0]), float(noise[1])), float(unbalance_ratio * math.sqrt(power[0]) / at_1x)
    )


def simulate(
    machine: BearingMachine,
    signal: FaultSignal,
    fault: Fault,
    level: NoiseLevels,
    rng: np.random.Generator,
    *,
    seconds: float = 0.5,
    rate_hz: float = 48_000.0,
) -> BearingRun:
    """Run a machine.

    Args:
        machine: the machine.
        signal: how its faults beat.
        fault: what is damaged.
        level: noise and unbalance.
        rng: of phases, slip and noise.
        seconds: length of the run; a run-in of 0.1 s goes before it.
        rate_hz: sampling rate.
    """
    n = round((seconds + RUN_IN_S) * rate_hz)
    # Silence at the end lets the last dip ring out before the period closes.
    padded = n + round(RUN_IN_S * rate_hz)
    y: Floats = rng.standard_normal((n, 2)) * level.noise
    t = np.arange(n) / rate_hz
    if fault != "healthy":
        fine = np.arange(n * OVERSAMPLING) / (rate_hz * OVERSAMPLING)
        spectrum = np.fft.rfft(signal.displacements(fault, fine, rng), n=padded * OVERSAMPLING)
        frequency_hz = np.asarray(np.fft.rfftfreq(padded, 1.0 / rate_hz), dtype=np.float64)
        answers = machine.accelerance(frequency_hz)[:, :, :2]
        spectrum = spectrum[:, : len(frequency_hz)] / OVERSAMPLING
        y += np.fft.irfft(np.einsum("fij,jf->if", answers, spectrum), n=padded)[:, :n].T
    phase = 2.0 * np.pi * rng.uniform()
    turning = level.unbalance_n * np.exp(1j * (2.0 * np.pi * signal.shaft_hz * t + phase))
    at_1x = machine.accelerance(np.array([signal.shaft_hz]))[0, :, 2]
    y += (turning[:, None] * at_1x).real
    part = slice(n - round(seconds * rate_hz), None)
    return BearingRun(y[part], turning.real[part])
