"""How fast the rotor bank is: nanoseconds per filter-step, against NumPy and FilterPy sample by sample.

Run by ``make bench``. Prints the compilation once cold and once from the cache, the linear observers and
the rub observer by block length, a bank of ten models with a rub in samples a second, and the ratios to a
NumPy loop and to FilterPy's ``MMAEFilterBank`` measured in the same run. Each target has a line of its own
with the ratio to what is asked for, 1 or more if it is met.
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
from targets import Targets

from daqsvc.rotor import kernels
from daqsvc.rotor.bank import ModelBank
from daqsvc.rotor.decision import DecisionRules
from daqsvc.rotor.discretise import BankMode, axis_flow, axis_process_covariance, discretise
from daqsvc.rotor.model import NormalisedRotor

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.rotor.decision import Rule

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
    # Only here: what else measures with this file starts without it.
    from filterpy.kalman import KalmanFilter, MMAEFilterBank

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


def bank_of(linear: int, rule: Rule = "cusum") -> ModelBank:
    """Linear observers and one with rub, the healthy mode declared."""
    modes = [BankMode(f"D{i}", rotor(0.18 - 0.1 * i / linear)) for i in range(linear)]
    modes.append(BankMode("R", rotor(0.02), process_noise=0.1, rub=True))
    return ModelBank(modes, noise=NOISE, duration=DURATION, rules=DecisionRules(rule=rule), decision=0)


def whole(subject: ModelBank, n: int, zeta: float = 0.18) -> float:
    """Nanoseconds per sample of a bank with both rules and its reports, on blocks of ``n``."""
    block = orbit(n, zeta)
    subject.process(*block)
    return best_ns(lambda: subject.process(*block), n)


def start_seconds(cache: str) -> float:
    """CPU seconds of the first block in a new process, with the kernel cache in a directory."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache, "PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run(
        [sys.executable, __file__, "--start"], env=environment, check=True, capture_output=True, text=True
    )
    return float(run.stdout)


def main() -> int:
    """Measure and print."""
    if sys.argv[1:] == ["--start"]:
        subject = bank()
        begin = time.process_time()
        subject.process(*orbit(16))
        print(time.process_time() - begin)
        return 0
    targets = Targets()
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
    print(f"FilterPy      {mmae:6.0f} ns per linear filter-step")
    slowest = math.inf
    for n in (PER_REV // 4, PER_REV, 4 * PER_REV):
        modes = list(bank_of(9).modes)
        alone = 1e3 / compiled(modes, n)
        rates = {rule: 1e3 / whole(bank_of(9, rule), n) for rule in ("cusum", "paper")}
        slowest = min(slowest, *rates.values())
        # The orbit is wider than the clearance, and nothing that the bank knows: the dearest that there is.
        worst = 1e3 / whole(bank_of(9), n, 0.047)
        print(
            f"ten models    {alone:6.2f} million samples/s in blocks of {n}, observers without a rule; with "
            f"both rules {rates['cusum']:.2f} if cusum decides, {rates['paper']:.2f} if the paper's does; "
            f"{worst:.2f} in contact all the time"
        )
    costs = {models: whole(bank_of(models - 1), PER_REV) for models in (8, 16, 32, 64)}
    print("whole bank    " + ", ".join(f"{m} models {cost:.0f} ns a sample" for m, cost in costs.items()))
    targets.ask(
        "ten models, both rules, 5 million samples/s", f"{slowest:.2f} in the slowest blocks", slowest / 5.0
    )
    targets.ask("linear observers 1000 times FilterPy", f"{mmae / step:.0f} times", mmae / step / 1000.0)
    # Linear or better: eight times the models cost no more than eight times as much.
    targets.ask(
        "cost linear in models",
        f"64 cost {costs[64] / costs[8]:.1f} times as much as 8",
        8.0 * costs[8] / costs[64],
    )
    return targets.exit_code


if __name__ == "__main__":
    sys.exit(main())
