"""Memory of a bank for its kernels: eight observers side by side, so that the processor steps them together.

All that a bank knows is in one array of bytes, `BankMemory`, which is passed on and copied as a whole. It has
a header (`HEADER`), groups of observers (`GROUP`), constants of the observers, and evidence of pairs of modes
(`PAIR`). Where the axes are coupled, it also has further constants of these observers (`coupled.COUPLED`).

A group holds constants, estimates and evidence of `WIDTH` modes, one member each; mode m is member m % WIDTH
of group m // WIDTH. The lengths are part of the type: that lets the compiler turn a loop over members into
vector instructions. Members that no mode needs explain nothing: their likelihood is 0.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.kernels import njit
from daqsvc.rotor.coupled import COUPLED
from daqsvc.rotor.discretise import OBSERVER
from daqsvc.rotor.kernels import ESCAPE_RADIUS, UNDETERMINED

if TYPE_CHECKING:
    from typing import Any, Self

    from numpy.typing import NDArray

    from daqsvc.rotor.decision import DecisionRules

    Bytes = NDArray[np.uint8]
    Floats = NDArray[np.float64]
    Observers = NDArray[np.void]
    Batch = NDArray[np.void]
    Headers = NDArray[np.void]
    Pairs = NDArray[np.void]
    Couplings = NDArray[np.void]

WIDTH = 8
"""Members in a group: two or one vector registers of float64."""
_LEAD_LIMIT = 1.5
"""The lead of the decision counts up to this many thresholds, so that a rival shows before it takes over."""

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

GROUP = np.dtype(
    [
        *((name, np.float64, (WIDTH,)) for name in _FLOATS),
        # samples since the onset of the CUSUM
        ("age", np.int64, (WIDTH,)),
        # not of the member's own mode: the modes with rub, one after the other
        ("rub", np.int64, (WIDTH,)),
    ]
)
"""A group of observers and the evidence for their modes."""

HEADER = np.dtype(
    [
        # what else there is: modes, groups of members, rub observers; modes with coupled axes, all or none
        ("modes", np.int64), ("groups", np.int64), ("rubs", np.int64), ("coupled", np.int64),
        # rules
        ("usable_squared", np.float64), ("lead_limit", np.float64), ("first_threshold", np.float64),
        ("identity_nats", np.float64), ("settling_wait", np.int64), ("samples_per_rev", np.int64),
        ("odds_bar", np.float64), ("largest_total", np.float64), ("by_paper", np.int64),
        # the state of the decision
        ("decision", np.int64), ("departed", np.int64), ("settling", np.int64), ("unusable", np.int64),
        ("paper_decision", np.int64), ("paper_leader", np.int64), ("paper_age", np.int64),
        ("paper_declarations", np.int64),
        # the last change of the decision
        ("changed_from", np.int64), ("changed_onset", np.int64),
    ],
)  # fmt: skip
"""What a bank knows in addition to its modes: an array of one."""

PAIR = np.dtype([("threshold", np.float64), ("log_ratio", np.float64)])
"""Of one mode against another: nats that change the decision to the other, infinite where they look alike;
and the one's evidence over the other, as long as there is no decision."""

_HEADER_BYTES = HEADER.itemsize
_GROUP_BYTES = GROUP.itemsize
_OBSERVER_BYTES = OBSERVER.itemsize
_PAIR_BYTES = PAIR.itemsize
_COUPLED_BYTES = COUPLED.itemsize


@njit(cache=True, nogil=True, error_model="numpy")
def sections(memory: Bytes) -> tuple[Headers, Batch, Observers, Pairs, Couplings]:
    """The parts of a bank's memory.

    Args:
        memory: uint8 ``[n]``.

    Returns:
        Views: ``[1]`` of `HEADER`, ``[G]`` of `GROUP`, ``[M]`` of `discretise.OBSERVER`, row by row ``[M M]``
        of `PAIR`, and ``[M]`` or ``[0]`` of `coupled.COUPLED`.
    """
    headers = memory[:_HEADER_BYTES].view(HEADER)
    batch = _HEADER_BYTES + headers[0]["groups"] * _GROUP_BYTES
    modes = headers[0]["modes"]
    observers = batch + modes * _OBSERVER_BYTES
    pairs = observers + modes * modes * _PAIR_BYTES
    return (
        headers,
        memory[_HEADER_BYTES:batch].view(GROUP),
        memory[batch:observers].view(OBSERVER),
        memory[observers:pairs].view(PAIR),
        memory[pairs:].view(COUPLED),
    )


class BankMemory:
    """All that a bank of M modes knows, in one piece.

    Args:
        memory: uint8 ``[n]``, as `sections` has it; see `new` for one of a new bank.

    Attributes:
        memory: the same.
    """

    __slots__ = ("memory",)

    def __init__(self, memory: Bytes) -> None:
        self.memory = memory

    @classmethod
    def new(cls, observers: Observers, couplings: Couplings, log_prior: Floats) -> Self:
        """Memory of a bank that has not seen anything yet.

        Args:
            observers: ``[M]`` of `discretise.OBSERVER`.
            couplings: ``[M]`` of `coupled.COUPLED`, or ``[0]``.
            log_prior: float64 ``[M]``, logarithms of the probabilities that the paper's rule starts from.
        """
        count = len(observers)
        groups = math.ceil(count / WIDTH)
        rubs = np.flatnonzero(observers["substeps"])
        size = _HEADER_BYTES + groups * _GROUP_BYTES + count * _OBSERVER_BYTES + count**2 * _PAIR_BYTES
        size += len(couplings) * _COUPLED_BYTES
        memory = np.zeros(size, dtype=np.uint8)
        header = memory[:_HEADER_BYTES].view(HEADER)
        header["modes"], header["groups"], header["rubs"] = count, groups, len(rubs)
        header["coupled"] = len(couplings)
        subject = cls(memory)
        subject.put("rub", rubs)
        subject.batch["threshold"] = math.inf
        subject.put("log_prior", log_prior, -math.inf)
        subject.put("log_odds", log_prior, -math.inf)
        subject.set_observers(observers, couplings)
        return subject

    @classmethod
    def of_bytes(cls, memory: bytes) -> Self:
        """A memory to look at."""
        return cls(np.frombuffer(memory, dtype=np.uint8))

    @property
    def header(self) -> np.void:
        """What is known in addition to the modes, one of `HEADER`."""
        header: np.void = np.ndarray(1, HEADER, self.memory)[0]
        return header

    @property
    def batch(self) -> Batch:
        """Observers and evidence, ``[G]`` of `GROUP`."""
        return np.ndarray(int(self.header["groups"]), GROUP, self.memory, _HEADER_BYTES)

    def each(self, name: str) -> Floats:
        """A figure of each mode, float64 ``[M]`` (int64 for ``age``), copied."""
        return np.array(self.batch[name].reshape(-1)[: int(self.header["modes"])])

    def put(self, name: str, values: NDArray[Any], rest: float = 0.0) -> None:
        """Set a figure of each mode, float64 ``[M]``; members without a mode get ``rest``."""
        batch = self.batch
        padded = np.full(len(batch) * WIDTH, rest)
        padded[: len(values)] = values
        batch[name] = padded.reshape(len(batch), WIDTH)

    def states(self, fields: tuple[str, ...]) -> Floats:
        """Deviations of the estimates, float64 ``[M, 4]``, of `FREE` or `PAPER`; copied."""
        return np.stack([self.each(name) for name in fields], axis=1)

    def set_states(self, fields: tuple[str, ...], values: Floats) -> None:
        """Put deviations ``[M, 4]`` back."""
        for column, name in enumerate(fields):
            self.put(name, values[:, column])

    def set_observers(self, observers: Observers, couplings: Couplings) -> None:
        """Take over the constants of observers; estimates and evidence stay.

        The member of a rub observer stands still in the vector loops and adds no evidence there; its own step
        does both.

        Args:
            observers: ``[M]`` of `discretise.OBSERVER`, with rub where there was.
            couplings: ``[M]`` or ``[0]`` of `coupled.COUPLED`, as many as there were.
        """
        parts = sections(self.memory)
        parts[2][:] = observers
        reach = parts[4]["reach_squared"].copy()
        parts[4][:] = couplings
        parts[4]["reach_squared"] = reach
        linear = observers["substeps"] == 0
        for name in _SAME:
            self.put(name, observers[name])
        drive_x = observers["xx"] * observers["gain_x"] + observers["xv"] * observers["gain_v"]
        drive_v = observers["vx"] * observers["gain_x"] + observers["vv"] * observers["gain_v"]
        self.put("closed_xx", np.where(linear, observers["xx"] - drive_x, 1.0))
        self.put("closed_xv", np.where(linear, observers["xv"], 0.0))
        self.put("closed_vx", np.where(linear, observers["vx"] - drive_v, 0.0))
        self.put("closed_vv", np.where(linear, observers["vv"], 1.0))
        self.put("drive_x", np.where(linear, drive_x, 0.0))
        self.put("drive_v", np.where(linear, drive_v, 0.0))
        self.put("weight", np.where(linear, -0.5 * observers["precision"], 0.0))
        self.put("log_norm", np.where(linear, observers["log_norm"], 0.0), math.inf)

    def set_rules(self, rules: DecisionRules, *, noise: float, samples_per_rev: int, decision: int) -> None:
        """Put the rules into the header, and the decision to begin with.

        Args:
            rules: thresholds and the rule that declares.
            noise: standard deviation of the measured position, in clearances.
            samples_per_rev: samples in a revolution.
            decision: index of the mode that is known to be true at the start, or -1.
        """
        header = self.header
        header["usable_squared"] = (ESCAPE_RADIUS + 6.0 * noise) ** 2
        header["lead_limit"] = _LEAD_LIMIT * rules.threshold_nats
        header["first_threshold"] = rules.threshold_nats
        header["identity_nats"] = rules.identity_nats
        header["settling_wait"] = round(rules.settle_revolutions * samples_per_rev)
        header["samples_per_rev"] = samples_per_rev
        # P(leader) > p takes odds of p / (1 - p) over every other mode, and all modes' sum below 1 / p.
        header["odds_bar"] = math.log(rules.probability_threshold / (1.0 - rules.probability_threshold))
        header["largest_total"] = 1.0 / rules.probability_threshold
        header["by_paper"] = rules.rule == "paper"
        header["decision"] = header["paper_decision"] = header["changed_from"] = decision

    def set_thresholds(self, thresholds: Floats) -> None:
        """Set what it takes to change the decision, float64 ``[M, M]``, infinite where modes look alike."""
        sections(self.memory)[3]["threshold"] = thresholds.ravel()
        decision = int(self.header["decision"])
        if decision != UNDETERMINED:
            self.put("threshold", thresholds[decision], math.inf)
