"""How fast the rotor bank is: nanoseconds per filter-step, against NumPy and FilterPy sample by sample.

Run by ``make bench``. Prints the compilation once cold and once from the cache, the linear observers and
the rub observer by block length, a bank of ten models with a rub in samples a second, and the ratios to a
NumPy loop and to FilterPy's ``MMAEFilterBank`` measured in the same run.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from typing import TYPE_CHECKING

import numpy as np
from filterpy.kalman import KalmanFilter, MMAEFilterBank

from daqsvc.rotor import kernels
from daqsvc.rotor.bank import ModelBank
from daqsvc.rotor.discretise import BankMode, axis_flow, axis_process_covariance, discretise
from daqsvc.rotor.model import NormalisedRotor

if TYPE_CHECKING:
    from collections.abc import Callable

PER_REV = 64
DURATION = 2.0 * math.pi / PER_REV
NOISE = 0.196
LINEAR_FILTERS = 10


def rotor(zeta: float) -> NormalisedRotor:
    """The paper's rotor with another damping."""
    return NormalisedRotor(w=1.0, e=0.1, zeta=zeta, g=0.1, contact_stiffness=30.0, mu=0.1)


def bank() -> ModelBank:
    """The paper's four modes."""
    modes = [BankMode(name, rotor(zeta)) for name, zeta in (("N", 0.18), ("F1", 0.1), ("F1L2", 0.06))]
    modes.append(BankMode("F1L3", rotor(0.02), process_noise=0.1, rub=True))
    return ModelBank(modes, noise=NOISE, duration=DURATION)


def orbit(n: int, zeta: float = 0.18) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noisy samples of a steady orbit, cosine and sine of the shaft angle."""
    angle = DURATION * np.arange(n)
    z = rotor(zeta).orbit() * np.exp(1j * angle) - 0.1j
    noise = NOISE * np.random.default_rng(0).standard_normal((n, 2))
    return np.column_stack((z.real, z.imag)) + noise, np.cos(angle), np.sin(angle)


def best_ns(work: Callable[[], None], steps: int) -> float:
    """Least time of a step in several runs, so that what else the machine does counts little."""
    repeats = max(5, 400_000 // steps)
    times = []
    for _ in range(7):
        begin = time.process_time_ns()
        for _ in range(repeats):
            work()
        times.append((time.process_time_ns() - begin) / repeats / steps)
    return min(times)


def compiled(modes: list[BankMode], n: int, zeta: float = 0.18) -> float:
    """Nanoseconds per sample of the kernel that the service runs, all modes, on blocks of ``n``."""
    observers = discretise(modes, noise=NOISE, duration=DURATION)
    xy, cos, sin = orbit(n, zeta)
    usable = np.ones(n, dtype=bool)
    states, scores = np.zeros((len(observers), 4)), np.empty((len(observers), n))
    kernels.run_free(xy, usable, cos, sin, observers, states, scores)
    return best_ns(lambda: kernels.run_free(xy, usable, cos, sin, observers, states, scores), n)


def numpy_loop(modes: list[BankMode], n: int) -> float:
    """The same linear observers, one NumPy step over the whole bank for every sample."""
    o = discretise(modes, noise=NOISE, duration=DURATION)
    xy, cos, sin = orbit(n)
    flow = np.array([[o["xx"], o["xv"]], [o["vx"], o["vv"]]]).transpose(2, 0, 1)
    gain = np.column_stack((o["gain_x"], o["gain_v"]))[:, :, np.newaxis]
    rotation = np.array([[o["a"], -o["b"]], [o["b"], o["a"]]]).transpose(2, 0, 1)
    rest = np.column_stack((o["rest_x"], o["rest_y"]))
    states = np.zeros((len(modes), 2, 2))

    def work() -> None:
        nonlocal states
        for k in range(n):
            innovation = xy[k] - (rotation @ (cos[k], sin[k]) + rest) - states[:, 0]
            _ = -0.5 * (innovation**2).sum(axis=1) * o["precision"] - o["log_norm"]
            states = flow @ (states + gain * innovation[:, np.newaxis])

    return best_ns(work, n * len(modes))


def filterpy_bank(modes: list[BankMode], n: int) -> float:
    """The same linear observers as a bank of FilterPy, fed with the deviation from the healthy orbit."""
    eye = np.eye(2)
    filters = []
    for mode in modes:
        kalman = KalmanFilter(dim_x=4, dim_z=2)
        kalman.F = np.kron(eye, axis_flow(mode.rotor, DURATION))
        kalman.Q = np.kron(eye, axis_process_covariance(mode.rotor, mode.process_noise, DURATION))
        kalman.H = np.kron(eye, [[1.0, 0.0]])
        kalman.R = NOISE**2 * eye
        kalman.P = 0.01 * np.eye(4)
        filters.append(kalman)
    subject = MMAEFilterBank(filters, p=[1.0 / len(modes)] * len(modes), dim_x=4)
    z = NOISE * np.random.default_rng(0).standard_normal((n, 2, 1))

    def work() -> None:
        for k in range(n):
            subject.predict()
            subject.update(z[k])

    work()
    begin = time.process_time_ns()
    work()
    return (time.process_time_ns() - begin) / n / len(modes)


def ten_model_bank(n: int) -> tuple[float, float]:
    """Nanoseconds per sample of ten models, one of them with a rub: observers alone, and with both rules."""
    linear = [BankMode(f"D{i}", rotor(0.18 - 0.01 * i)) for i in range(LINEAR_FILTERS - 1)]
    modes = [*linear, BankMode("R", rotor(0.02), process_noise=0.1, rub=True)]
    subject, block = ModelBank(modes, noise=NOISE, duration=DURATION, decision=0), orbit(n)
    subject.process(*block)
    return compiled(modes, n), best_ns(lambda: subject.process(*block), n)


def start_seconds(cache: str) -> float:
    """CPU seconds of the first block in a new process, with the kernel cache in a directory."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache, "PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run(
        [sys.executable, __file__, "--start"], env=environment, check=True, capture_output=True, text=True
    )
    return float(run.stdout)


def main() -> None:
    """Measure and print."""
    if sys.argv[1:] == ["--start"]:
        subject = bank()
        begin = time.process_time()
        subject.process(*orbit(16))
        print(time.process_time() - begin)
        return
    with tempfile.TemporaryDirectory() as cache:
        cold, cached = start_seconds(cache), start_seconds(cache)
    print(f"first block   {cold:6.2f} s CPU with compilation, {cached:.2f} s from the cache")
    linear = [BankMode(f"D{i}", rotor(0.18 - 0.01 * i)) for i in range(LINEAR_FILTERS)]
    rub = BankMode("R", rotor(0.02), process_noise=0.1, rub=True)
    loop = numpy_loop(linear, 256)
    print(f"numpy loop    {loop:6.0f} ns per linear filter-step, bank of {LINEAR_FILTERS}")
    for n in (1, 16, 64, 1024):
        step = compiled(linear, n) / LINEAR_FILTERS
        # With this damping the orbit is wider than the clearance: contact all the time.
        contact = compiled([*linear, rub], n, 0.047) - compiled(linear, n, 0.047)
        print(
            f"blocks of {n:4} {step:6.1f} ns per linear filter-step ({loop / step:.0f} times the loop), "
            f"{contact:.0f} ns per rub filter-step"
        )
    mmae = filterpy_bank(linear, 200)
    step = compiled(linear, PER_REV // 4) / LINEAR_FILTERS
    print(
        f"FilterPy      {mmae:6.0f} ns per linear filter-step, {mmae / step:.0f} times ours in blocks of 16"
    )
    for n in (PER_REV // 4, PER_REV, 16 * PER_REV):
        observers, whole = ten_model_bank(n)
        print(
            f"ten models    {1e3 / observers:6.2f} million samples/s in blocks of {n}, one model with rub; "
            f"{1e3 / whole:.2f} with both rules"
        )
    subject, block = bank(), orbit(PER_REV // 4)
    whole = best_ns(lambda: subject.process(*block), 1)
    print(f"whole bank    {whole / 1000:6.1f} us per block of {PER_REV // 4} samples, both rules")


if __name__ == "__main__":
    main()
