"""Which mode the machine is in: two rules over the same observers.

``cusum`` keeps a mode until another has gathered a threshold of evidence against it; this is the
rule that may raise alarms. ``paper`` declares at a conditional probability of 0.9 and starts
again. A posterior of 0.9 is an error of 10 % per declaration by construction, so it is only shown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

Rule = Literal["cusum", "paper"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DecisionRules:
    """Thresholds of both rules.

    A mean time between failures sets a threshold: ln(1 / pi) of the prior pi per decision, so a rarer
    transition gets a higher one (`from_rates`). As a prior of the paper's rule, it would declare the most
    likely mode again at every sample.

    Attributes:
        rule: the rule whose mode counts as declared.
        threshold_nats: evidence that changes the decision to a worse mode.
        back_threshold_nats: evidence that changes it to a healthier mode (one before it in the list).
        identity_nats: lead over the other candidates that a change of the decision needs: odds of 20 to 1.
        settle_revolutions: time since the onset of its evidence that a change of the decision waits for; the
            departure is reported at once. The transient after a severe fault passes close to the orbits of
            milder faults of other kinds, so that a bank of many kinds of faults needs some four revolutions.
        group_nats: lead below which two modes are not told apart: odds of 150 to 1.
        alike_nats_per_rev: steady evidence a revolution, by the models, below which two modes are always one
            group.
        probability_threshold: conditional probability that declares under the paper's rule.
        priors: probabilities that the paper's rule starts and resets to; equal if not given.
    """

    rule: Rule = "cusum"
    threshold_nats: float = 16.0
    back_threshold_nats: float = 25.0
    identity_nats: float = 3.0
    settle_revolutions: float = 0.0
    group_nats: float = 5.0
    alike_nats_per_rev: float = 0.3
    probability_threshold: float = 0.9
    priors: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if self.rule not in ("cusum", "paper"):
            raise ValueError(f"decision rule {self.rule!r} is unknown; use 'cusum' or 'paper'")
        for name in (
            "threshold_nats", "back_threshold_nats", "identity_nats", "group_nats", "alike_nats_per_rev"
        ):  # fmt: skip
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"decision rule: {name} is {value}; evidence is a finite number above 0")
        if not (math.isfinite(self.settle_revolutions) and self.settle_revolutions >= 0.0):
            raise ValueError(
                f"decision rule: settle_revolutions is {self.settle_revolutions}; it is a number from 0 up"
            )
        if not 0.5 <= self.probability_threshold < 1.0:
            raise ValueError(
                f"decision rule: probability_threshold is {self.probability_threshold}; "
                "it must lie in [0.5, 1), so that only one mode can pass it"
            )

    @classmethod
    def from_rates(
        cls,
        *,
        false_alarms_per_1000_rev: float | None,
        mtbf_hours: float | None,
        speed_rpm: float,
        samples_per_rev: float,
        modes: int,
        **others: Any,
    ) -> Self:
        """Thresholds from how often the bank may be wrong: h = ln(1 / pi), pi per sample and rival mode.

        A CUSUM of log-likelihood ratios crosses h by chance once in exp(h) samples on average or less
        often (Lorden 1971), for each rival. Forward, the wanted rate of false alarms sets pi. Back, a
        machine does not heal while it turns: pi is one in a mean time between failures. At 600 rpm, 64
        samples a revolution and four modes, 0.02 false alarms in 1000 revolutions and 10,000 h make the
        defaults, 16 nats forward and 25 back.

        The rate is a bound for a machine that is as its healthy mode.

        Args:
            false_alarms_per_1000_rev: accepted on a healthy machine; None to leave ``threshold_nats``.
            mtbf_hours: mean time between failures; None to leave ``back_threshold_nats``.
            speed_rpm: of the shaft; the sign does not matter.
            samples_per_rev: samples a revolution.
            modes: number of modes in the bank.
            **others: further attributes of the rules.

        Raises:
            ValueError: a figure is not above 0, or the rate is so high that no evidence would be needed.
        """
        rates = {"false_alarms_per_1000_rev": false_alarms_per_1000_rev, "mtbf_hours": mtbf_hours}
        for name, value in rates.items():
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"decision rule: {name} is {value}; it must be a finite number above 0")
        chances_per_rev = samples_per_rev * (modes - 1)
        thresholds: dict[str, float] = {}
        if false_alarms_per_1000_rev is not None:
            thresholds["threshold_nats"] = math.log(1000.0 * chances_per_rev / false_alarms_per_1000_rev)
        if mtbf_hours is not None:
            revolutions = 60.0 * mtbf_hours * abs(speed_rpm)
            thresholds["back_threshold_nats"] = math.log(revolutions * chances_per_rev)
        return cls(**(others | thresholds))

    def log_priors(self, names: Sequence[str]) -> Floats:
        """Logarithms of the priors of the named modes, float64 ``[M]``.

        Raises:
            ValueError: not one prior for each mode, not summing to 1, or one that declares by itself.
        """
        count = len(names)
        if self.priors is None:
            return np.full(count, -math.log(count))
        if len(self.priors) != count:
            raise ValueError(f"decision rule: {len(self.priors)} priors for {count} modes; give one for each")
        for name, prior in zip(names, self.priors, strict=True):
            if not 0.0 < prior < self.probability_threshold:
                raise ValueError(
                    f"decision rule: the prior of mode {name!r} is {prior}; it must lie between 0 and the "
                    f"threshold {self.probability_threshold}, or the rule declares without evidence; "
                    "put what is known about failure rates into the evidence thresholds"
                )
        if not math.isclose(math.fsum(self.priors), 1.0, rel_tol=0.0, abs_tol=1e-6):
            raise ValueError(f"decision rule: the priors sum to {math.fsum(self.priors)}, not to 1")
        return np.log(np.asarray(self.priors, dtype=np.float64))

    def thresholds(self, count: int) -> Floats:
        """Evidence that changes the decision from the row's mode to the column's, float64 ``[M, M]``."""
        back = np.tril(np.ones((count, count), dtype=bool), -1)
        return np.where(back, self.back_threshold_nats, self.threshold_nats)


@dataclass(frozen=True, slots=True)
class Departure:
    """The machine has left the declared mode, and the cause is not yet known.

    Attributes:
        sample: the sample that brought the evidence, counted from the last one of the block: 0 or less.
        onset: the first sample of that evidence, on the same count.
        candidates: indices of the modes that are close to the leading one, or look like it.
    """

    sample: int
    onset: int
    candidates: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Declaration:
    """A change of the declared mode.

    Attributes:
        sample: position in the block of the sample that brought the decision.
        mode: index of the mode declared.
        previous: index of the mode before, -1 if there was none.
        onset: position of the first sample of its evidence, relative to the same block; often negative.
    """

    sample: int
    mode: int
    previous: int
    onset: int
