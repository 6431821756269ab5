"""Memory of a bank for its kernels: eight observers side by side, so that the processor steps them together.

A group of `LANES` holds constants, estimates and evidence of `WIDTH` modes, one lane each; mode m is lane
m % WIDTH of group m // WIDTH. The lengths are part of the type: that is what lets the compiler turn a loop
over lanes into vector instructions. Lanes that no mode needs explain nothing: their likelihood is 0.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.rotor.decision import DecisionRules

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]
    Ints = NDArray[np.int64]
    Observers = NDArray[np.void]
    Lanes = NDArray[np.void]
    Desk = NDArray[np.void]

WIDTH = 8
"""Lanes in a group: two or one vector registers of float64."""
_LEAD_LIMIT = 1.5
"""The lead of the decision counts up to this many thresholds, so that a doubt shows before it wins."""

FREE = ("free_x", "free_u", "free_y", "free_v")
"""Deviation ``(x, x', y, y')`` of the free-running estimate from the mode's orbit."""
PAPER = ("paper_x", "paper_u", "paper_y", "paper_v")
"""That of the estimate under the paper's rule, which hands estimates over."""

_SAME = ("a", "b", "rest_x", "rest_y", "speed", "xx", "xv", "vx", "vv", "gain_x", "gain_v")
_FLOATS = (
    *_SAME, *FREE, *PAPER,
    # closed loop x+ = F (I - K C) x + F K z of the linear observers, and their likelihood
    "closed_xx", "closed_xv", "closed_vx", "closed_vv", "drive_x", "drive_v", "weight", "log_norm",
    # of the present sample: measured less orbit, log-likelihood
    "z_x", "z_y", "score", "paper_score",
    # CUSUM: evidence against the decision, evidence of the decision, what it takes to change
    "cusum", "lead", "threshold",
    # the paper's rule: logarithm of the probabilities but for a common factor, and where it starts
    "log_odds", "log_prior",
)  # fmt: skip

LANES = np.dtype([*((name, np.float64, (WIDTH,)) for name in _FLOATS), ("age", np.int64, (WIDTH,))])
"""A group of observers and the evidence for their modes."""

DESK = np.dtype(
    [
        # rules
        ("usable_squared", np.float64), ("lead_limit", np.float64), ("first_threshold", np.float64),
        ("identity_nats", np.float64), ("settling_wait", np.int64), ("samples_per_rev", np.int64),
        ("odds_bar", np.float64), ("largest_total", np.float64), ("by_paper", np.int64),
        # where the decision stands
        ("decision", np.int64), ("departed", np.int64), ("settling", np.int64), ("unusable", np.int64),
        ("paper_decision", np.int64), ("paper_leader", np.int64), ("paper_age", np.int64),
        ("paper_declarations", np.int64),
        # the last change of the decision
        ("changed_from", np.int64), ("changed_onset", np.int64),
    ],
)  # fmt: skip
"""What a bank knows besides its lanes: an array of one."""

THRESHOLD = 0
"""Of the pairs of modes: nats that change the decision from row to column, infinite where they look alike."""
DUEL = 1
"""Of the pairs of modes: evidence of row over column, as long as there is no decision."""


def new_lanes(observers: Observers, log_prior: Floats) -> Lanes:
    """Memory of a bank that has not seen anything yet.

    Args:
        observers: ``[M]`` of `discretise.OBSERVER`.
        log_prior: float64 ``[M]``, logarithms of the probabilities that the paper's rule starts from.

    Returns:
        ``[ceil(M / WIDTH)]`` of `LANES`.
    """
    lanes = np.zeros(math.ceil(len(observers) / WIDTH), dtype=LANES)
    lanes["threshold"] = math.inf
    set_each(lanes, "log_prior", log_prior, -math.inf)
    lanes["log_odds"] = lanes["log_prior"]
    set_constants(lanes, observers)
    return lanes


def set_constants(lanes: Lanes, observers: Observers) -> None:
    """Take over the constants of observers; estimates and evidence stay.

    The lane of a rub observer stands still in the vector loops and adds no evidence there; its own step
    does both.

    Args:
        lanes: memory of the bank.
        observers: ``[M]`` of `discretise.OBSERVER`.
    """
    linear = observers["substeps"] == 0
    for name in _SAME:
        set_each(lanes, name, observers[name])
    drive_x = observers["xx"] * observers["gain_x"] + observers["xv"] * observers["gain_v"]
    drive_v = observers["vx"] * observers["gain_x"] + observers["vv"] * observers["gain_v"]
    set_each(lanes, "closed_xx", np.where(linear, observers["xx"] - drive_x, 1.0))
    set_each(lanes, "closed_xv", np.where(linear, observers["xv"], 0.0))
    set_each(lanes, "closed_vx", np.where(linear, observers["vx"] - drive_v, 0.0))
    set_each(lanes, "closed_vv", np.where(linear, observers["vv"], 1.0))
    set_each(lanes, "drive_x", np.where(linear, drive_x, 0.0))
    set_each(lanes, "drive_v", np.where(linear, drive_v, 0.0))
    set_each(lanes, "weight", np.where(linear, -0.5 * observers["precision"], 0.0))
    set_each(lanes, "log_norm", np.where(linear, observers["log_norm"], 0.0), math.inf)


def new_desk(rules: DecisionRules, *, decision: int, usable_squared: float, samples_per_rev: int) -> Desk:
    """The desk of a bank.

    Args:
        rules: thresholds and the rule that declares.
        decision: index of the mode that is known to be true at the start, or -1.
        usable_squared: square of the distance from the centre beyond which a sample is wrong, clearances.
        samples_per_rev: samples in a revolution.
    """
    desk = np.zeros(1, dtype=DESK)
    desk["usable_squared"] = usable_squared
    desk["lead_limit"] = _LEAD_LIMIT * rules.threshold_nats
    desk["first_threshold"] = rules.threshold_nats
    desk["identity_nats"] = rules.identity_nats
    desk["settling_wait"] = round(rules.settle_revolutions * samples_per_rev)
    desk["samples_per_rev"] = samples_per_rev
    # P(leader) > p takes odds of p / (1 - p) over every other mode, and all modes' sum below 1 / p.
    desk["odds_bar"] = math.log(rules.probability_threshold / (1.0 - rules.probability_threshold))
    desk["largest_total"] = 1.0 / rules.probability_threshold
    desk["by_paper"] = rules.rule == "paper"
    desk["decision"] = desk["paper_decision"] = desk["changed_from"] = decision
    return desk


def each(lanes: Lanes, name: str, count: int) -> Floats:
    """A figure of each mode, float64 ``[M]`` (int64 for ``age``); a copy if there are several groups."""
    return np.asarray(lanes[name].reshape(-1)[:count])


def states(lanes: Lanes, fields: tuple[str, ...], count: int) -> Floats:
    """Deviations of the estimates, float64 ``[M, 4]``, of `FREE` or `PAPER`."""
    return np.stack([each(lanes, name, count) for name in fields], axis=1)


def set_states(lanes: Lanes, fields: tuple[str, ...], values: Floats) -> None:
    """Put deviations ``[M, 4]`` back."""
    for column, name in enumerate(fields):
        set_each(lanes, name, values[:, column])


def set_each(lanes: Lanes, name: str, values: Floats, rest: float = 0.0) -> None:
    """Set a figure of each mode, float64 ``[M]``; lanes without a mode get ``rest``."""
    padded = np.full(len(lanes) * WIDTH, rest)
    padded[: len(values)] = values
    lanes[name] = padded.reshape(len(lanes), WIDTH)
