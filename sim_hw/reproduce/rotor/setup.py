"""The paper's numbers (section V), and those that it leaves open."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from daqsvc.rotor.discretise import BankMode
from daqsvc.rotor.model import NormalisedRotor
from sim_hw.plants.rotor import PlantParameters

if TYPE_CHECKING:
    from daqsvc.rotor.decision import Rule

MODES = ("N", "F1", "F1L2", "F1L3")
DAMPING = {"N": 0.18, "F1": 0.10, "F1L2": 0.06, "F1L3": 0.02}
MODE_DURATION = 170.0
"""Normalised time that N, F1 and F1 L2 last each."""
PAPER_REVOLUTIONS = 26
"""What the paper takes that to be in revolutions."""
RUB_REVOLUTIONS = 80
"""Revolutions that F1 L3 lasts."""
SNR_DB = (-5.0, 0.0, 5.0)
"""The paper's range of signal-to-noise ratios, and its middle."""
CONVERGENCE = 520.0
"""Normalised time at which the paper sees the error of the F1 L3 observer begin to converge."""
OBSERVER_ALPHA, OBSERVER_MU = 1.0, 0.1
"""Exponent and friction of the F1 L3 observer; the process has 1.5 and 0.3."""

# From here on the paper is silent.
SAMPLES_PER_REV = 64
SAMPLE = 2.0 * math.pi / SAMPLES_PER_REV
"""Normalised time between samples at w = 1."""
PROCESS_NOISE = 1e-4
"""Power spectral density of the acceleration noise that the linear observers are designed for."""
RUB_PROCESS_NOISE: dict[Rule, float] = {"paper": 3e-4, "cusum": 0.1}
"""That of the rub observer.

Under the paper's rule, and in figure 5, it trusts its model, so that its error shows when the model holds.
Under this service's own rule it follows nearly everything, which makes it a weak rival of the others in
transients.
"""


def plant(mode: str) -> PlantParameters:
    """The process in a mode: w = 1, e = 0.1, k = 1, g = 0.1, K* = 30, alpha = 1.5, mu = 0.3."""
    return replace(PlantParameters(), damping_ratio=DAMPING[mode])


def hypotheses(rule: Rule) -> tuple[BankMode, ...]:
    """The observers' models for a decision rule, with the mismatch of the rub observer.

    Args:
        rule: the rule.
    """
    return tuple(
        BankMode(
            mode,
            _model(mode),
            RUB_PROCESS_NOISE[rule] if mode == "F1L3" else PROCESS_NOISE,
            rub=mode == "F1L3",
        )
        for mode in MODES
    )


def _model(mode: str) -> NormalisedRotor:
    process = plant(mode)
    return NormalisedRotor(
        w=process.speed_ratio,
        e=process.eccentricity,
        zeta=process.damping_ratio,
        k=process.stiffness,
        g=process.gravity,
        contact_stiffness=process.contact_stiffness,
        alpha=OBSERVER_ALPHA,
        mu=OBSERVER_MU,
        contact_radius=process.disc_radius,
    )


def spoken(mode: str) -> str:
    """A mode as the paper writes it, ``F1 L2`` for ``F1L2``."""
    return mode.replace("L", " L")


def in_decibels(snr_db: float) -> str:
    """A signal-to-noise ratio with sign and unit."""
    return f"{snr_db:+g} dB" if snr_db else "0 dB"
