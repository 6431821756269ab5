"""Has 1X changed since the healthy run? Without a phase reference, and without a model of the machine.

Two recordings of one machine at one speed are compared by their orders 1X to 3X on one or more channels. The
zero of the shaft's angle is arbitrary in each, so the healthy vectors may turn: order h by h phi, with the
one phi that brings them closest to the present ones. What remains,

    T = min over phi of sum over orders h, channels c of nu ln(1 + |d_hc|^2 / (nu u_hc^2)),
    d_hc = p_hc - exp(i h phi) b_hc

is the departure. Each term is -ln of the probability of such a change by chance, so T of an unchanged
machine is Gamma distributed, and smaller by the choice of phi. Here u^2 is the variance of the two means,
of nu degrees of freedom, by the spectra of their own blocks beside each order and by what each order
drifted.

A change must be significant and large. It is then attributed by its spectrum as velocity, the measure of
ISO 20816. Unbalance acts at 1X with the square of the speed, and what its 2X and 3X add comes of the
supports being not quite linear. Less damping near a resonance does the same, and without a phase and a
model nothing tells the two apart: they are always named together.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from daqsvc.dsp.speed.lines import ORDERS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.dsp.orders import OrderVectors

    Floats: TypeAlias = NDArray[np.float64]
    Complexes: TypeAlias = NDArray[np.complex128]


Cause = Literal["unbalance", "damping_loss", "unmodelled"]

_SCALES = 2.0 ** np.arange(-3, 7)
"""How large a change may be, as multiples of the healthy level: integrated over."""
_HARMONIC_SHARES = (0.0, 0.02, 0.1, 0.3, 0.6)
"""2X and 3X that unbalance brings along, over its 1X, as velocity: integrated over."""
_OPEN_NATS = -6.0
"""An unmodelled change can explain anything, so it must explain a change better by this much."""


def surprise(change: Complexes, variance: Floats, freedom: Floats) -> Floats:
    """-ln of the probability of a larger change by chance: Exp(1) of an unchanged component.

    |change|^2 / variance is F with 2 and 2 nu degrees of freedom, and its survival a power.
    """
    return np.asarray(freedom * np.log1p(np.abs(change) ** 2 / (freedom * variance)))


def cause_evidence(
    change: Complexes, variance: Floats, freedom: Floats, level: float, *, growing: bool
) -> dict[Cause, float]:
    """Log marginal likelihood of the causes over "normal", amplitudes integrated over.

    Args:
        change: complex128 ``[3, channels]``, as velocity.
        variance: of it.
        freedom: complex degrees of freedom of the variance.
        level: length of the healthy vector, as velocity.
        growing: whether 1X is longer now.
    """

    def gain(order: int, sizes: Floats) -> Floats:
        """Nats of a change of this order that is CN(0, size^2), for each size."""
        power, noise = np.abs(change[order]) ** 2, variance[order]
        total = noise + sizes[:, np.newaxis] ** 2
        normal = (1.0 + 1.0 / freedom[order]) * surprise(change[order], noise, freedom[order])
        return np.asarray((normal - power / total - np.log(total / noise)).sum(axis=1))

    sizes: Floats = np.asarray(_SCALES * level, dtype=np.float64)
    unbalance = 0.0
    if growing:
        terms = [
            gain(0, sizes) + sum((gain(order, share * sizes) for order in (1, 2)), np.zeros(len(sizes)))
            for share in _HARMONIC_SHARES
        ]
        unbalance = _log_mean(np.concatenate(terms))
    alone = [_log_mean(gain(order, sizes)) for order in range(len(ORDERS))]
    # 1X that grows alone is what unbalance does: no need of an unknown cause.
    subsets = [
        sum(alone[row] for row in rows)
        for count in range(1, len(ORDERS) + 1)
        for rows in itertools.combinations(range(len(ORDERS)), count)
        if not (growing and rows == (0,))
    ]
    return {
        "unbalance": unbalance,
        "damping_loss": unbalance,
        "unmodelled": _log_mean(np.array(subsets)) + _OPEN_NATS,
    }


def _log_mean(nats: Floats) -> float:
    """Logarithm of the mean of exponentials."""
    most = float(nats.max())
    return most + math.log(float(np.exp(nats - most).mean()))


OrderVerdict = Literal["normal", "unbalance", "damping_loss", "unmodelled", "small_change"]

_ANGLES = 2.0 * np.pi * np.arange(720) / 720
_NOISE_LINES = 3
"""Lines on either side of an order, one over the recording's length apart, that show its noise."""
_VELOCITY = 1.0 / np.array(ORDERS, dtype=np.float64)[:, np.newaxis]
"""Acceleration to velocity, in units of the shaft speed."""


@dataclass(frozen=True, slots=True)
class OrderRules:
    """What counts as a change.

    Attributes:
        false_alarm_probability: of an unchanged machine's recording, to be called changed; at most.
        least_change: size below which a change is not named, as a part of the healthy orders' velocity; 1X
            must have grown by this part of itself.
        repeatability: size below which a change does not count: measurements repeat no better.
        least_residual_ratio: rise of what is left beside the orders that is a change by itself.
        margin_nats: lead of one cause over the others to be named alone.
        most_speed_difference: part of the healthy run's speed beyond which two runs are not compared.

    Raises:
        ValueError: a figure that cannot be.
    """

    false_alarm_probability: float = 1e-3
    least_change: float = 0.25
    repeatability: float = 0.05
    least_residual_ratio: float = 2.0
    margin_nats: float = 3.0
    most_speed_difference: float = 0.05

    def __post_init__(self) -> None:
        if not 1e-9 <= self.false_alarm_probability <= 0.5:
            raise ValueError(
                f"a false-alarm probability of {self.false_alarm_probability:g} per recording: "
                "give one from 1e-9 to 0.5"
            )
        if not (self.least_change >= self.repeatability >= 0.0 and self.least_residual_ratio > 1.0):
            raise ValueError(
                f"a least change of {self.least_change:g}, a repeatability of {self.repeatability:g} and a "
                f"least residual ratio of {self.least_residual_ratio:g}: give a change no smaller than the "
                "repeatability, and a ratio above 1"
            )

    @property
    def test_probability(self) -> float:
        """False-alarm probability of each of the three tests: orders, growth of 1X, residual."""
        return self.false_alarm_probability / 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderChange:
    """What two recordings show about a machine.

    Attributes:
        verdict: the most likely member of ``group``.
        group: what the evidence cannot tell apart, the most likely first.
        probabilities: of every verdict, summing to one.
        evidence: nats over "normal" of the causes.
        departure: T, in nats.
        departure_threshold: T that is exceeded with the false-alarm probability.
        severity: size of the change as a part of the healthy orders' velocity.
        growth: 1X now over 1X healthy, lengths of the vectors over all channels; infinite if the healthy one
            is nothing.
        growth_uncertainty: standard deviation of ``growth``.
        growth_significant: whether 1X has grown, at the false-alarm probability.
        healthy: float64 ``[3, channels]``, amplitudes of the orders in the healthy run.
        present: the same now.
        present_uncertainty: float64 ``[3, channels]``, standard deviation of each component of them.
        residual_ratio: float64 ``[channels]``, root mean square beside the orders, now over healthy.
        residual_changed: whether its rise is a change.
    """

    verdict: OrderVerdict
    group: tuple[OrderVerdict, ...]
    probabilities: Mapping[OrderVerdict, float]
    evidence: Mapping[Cause, float]
    departure: float
    departure_threshold: float
    severity: float
    growth: float
    growth_uncertainty: float
    growth_significant: bool
    healthy: Floats
    present: Floats
    present_uncertainty: Floats
    residual_ratio: Floats
    residual_changed: bool

    @property
    def ratio(self) -> Floats:
        """float64 ``[3, channels]``, amplitude now over healthy; infinite where that was nothing."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.present / self.healthy)


def compare_orders(
    baseline: OrderVectors, present: OrderVectors, rules: OrderRules | None = None
) -> OrderChange:
    """Compare a recording with one of the healthy machine at the same speed.

    Args:
        baseline: of the healthy machine.
        present: of now, the same channels in the same unit.
        rules: what counts as a change.

    Raises:
        ValueError: the channels or the speeds differ.
    """
    rules = rules or OrderRules()
    _check_alike(baseline, present, rules)
    was, now = _Mean.of(baseline), _Mean.of(present)
    variance, freedom = was.variance + now.variance, _freedom(was, now)
    change = _change(was.mean, now.mean, variance, freedom)
    departure = float(surprise(change, variance, freedom).sum())
    threshold = _departure_threshold(change.size, rules.test_probability)

    level = _length(was.mean * _VELOCITY, was.variance * _VELOCITY**2)
    severity = _excess(change * _VELOCITY, variance * _VELOCITY**2) / level
    growth, growth_uncertainty, grown = _growth(was, now, rules)
    residual = _ResidualChange.of(baseline, present, rules)
    evidence = cause_evidence(
        change * _VELOCITY, variance * _VELOCITY**2, freedom, level, growing=growth > 1.0
    )
    # A difference below the repeatability is no change, however significant.
    beyond = departure - threshold
    departed = beyond > 0.0 and severity > rules.repeatability
    excess = max(beyond if departed or beyond <= 0.0 else -np.inf, residual.excess, 0.0 if grown else -np.inf)
    large = grown or residual.changed or severity >= rules.least_change
    if not (grown or departed or residual.changed):
        group: tuple[OrderVerdict, ...] = ("normal",)
    elif not large:
        group = ("small_change",)
    else:
        # Vibration beside the orders does not show whether 1X has changed.
        group = _causes(evidence, rules, growth=growth if departed or grown else 1.0, grown=grown)
    return OrderChange(
        verdict=group[0],
        group=group,
        probabilities=_probabilities(group, evidence, excess),
        evidence=evidence,
        departure=departure,
        departure_threshold=threshold,
        severity=severity,
        growth=growth,
        growth_uncertainty=growth_uncertainty,
        growth_significant=grown,
        healthy=np.abs(was.mean),
        present=np.abs(now.mean),
        present_uncertainty=np.sqrt(now.variance / 2.0),
        residual_ratio=residual.ratio,
        residual_changed=residual.changed,
    )


def _check_alike(baseline: OrderVectors, present: OrderVectors, rules: OrderRules) -> None:
    if baseline.channels != present.channels:
        raise ValueError(
            f"the healthy run has {baseline.channels} channels and this one {present.channels}: "
            "compare the same channels"
        )
    difference = present.speed_rpm / baseline.speed_rpm - 1.0
    unknown = math.hypot(present.speed_uncertainty_rpm, baseline.speed_uncertainty_rpm) / baseline.speed_rpm
    if abs(difference) > rules.most_speed_difference + 3.0 * unknown:
        raise ValueError(
            f"the shaft turns at {present.speed_rpm:.0f} rpm, {difference:+.1%} from the healthy run's "
            f"{baseline.speed_rpm:.0f} rpm; 1X changes with speed by itself: give a healthy run within "
            f"{rules.most_speed_difference:.0%} of this speed"
        )


@dataclass(frozen=True, slots=True)
class _Mean:
    """Mean order vectors of a recording.

    Attributes:
        mean: complex128 ``[3, channels]``.
        variance: float64 ``[3, channels]``, complex variance of it.
        freedom: complex degrees of freedom behind each variance.
    """

    mean: Complexes
    variance: Floats
    freedom: int

    @classmethod
    def of(cls, vectors: OrderVectors) -> _Mean:
        """The mean of correlated blocks has the variance that their spectrum has at zero frequency.

        It is read from the lines next to zero. What the order drifted through the recording it may drift
        again until the next one: orders of real machines wander for longer than a short recording sees.
        """
        count = len(vectors)
        lines = np.fft.fft(vectors.amplitudes, axis=0) / count
        reach = min(_NOISE_LINES, (count - 1) // 2)
        beside = np.concatenate([lines[1 : reach + 1], lines[-reach:]])
        # Sums in floating point leave something even of harmonics that are pure.
        floor = (np.finfo(np.float32).eps * np.abs(lines[0]).max()) ** 2 + np.finfo(np.float64).tiny
        noise = (np.abs(beside) ** 2).mean(axis=0)
        place = (np.arange(count) - (count - 1) / 2.0) / count
        drift = np.tensordot(place, vectors.amplitudes, 1) / (place**2).sum()
        return cls(lines[0], noise + np.abs(drift) ** 2 + floor, 2 * reach)


def _freedom(was: _Mean, now: _Mean) -> Floats:
    """Complex degrees of freedom of the sum of two variances (Welch and Satterthwaite)."""
    spread = was.variance**2 / was.freedom + now.variance**2 / now.freedom
    return np.asarray((was.variance + now.variance) ** 2 / spread)


def _change(was: Complexes, now: Complexes, variance: Floats, freedom: Floats) -> Complexes:
    """The present vectors less the healthy ones, these turned so that chance explains the difference best."""
    turns = np.exp(1j * np.outer(_ANGLES, ORDERS))[:, :, np.newaxis]
    changes = now - turns * was
    return np.asarray(changes[np.argmin(surprise(changes, variance, freedom).sum(axis=(1, 2)))])


def _departure_threshold(components: int, probability: float) -> float:
    """T, a sum of exponentials, that chance exceeds with a probability."""
    from scipy.special import gammainccinv  # noqa: PLC0415 - scipy takes long to import

    return float(gammainccinv(components, probability))


def _excess(vectors: Complexes, variance: Floats) -> float:
    """Length of a vector without what its noise adds."""
    return math.sqrt(max(float((np.abs(vectors) ** 2).sum() - variance.sum()), 0.0))


def _length(vectors: Complexes, variance: Floats) -> float:
    """Length of a vector, but never less than its noise."""
    return math.sqrt(max(float((np.abs(vectors) ** 2).sum()), float(variance.sum())))


def _growth(was: _Mean, now: _Mean, rules: OrderRules) -> tuple[float, float, bool]:
    """1X over healthy 1X, its deviation, and whether it has grown: significantly, and by enough."""
    from scipy.special import stdtrit  # noqa: PLC0415 - scipy takes long to import

    before = _length(was.mean[0], was.variance[0])
    after = _length(now.mean[0], now.variance[0])
    spread_before, spread_after = (
        math.sqrt(
            float((np.maximum(np.abs(run.mean[0]) ** 2, run.variance[0]) * run.variance[0]).sum() / 2.0)
        )
        / length
        for run, length in ((was, before), (now, after))
    )
    growth = after / before
    deviation = math.hypot(spread_after / before, growth * spread_before / before)
    needed = float(stdtrit(2 * min(was.freedom, now.freedom), 1.0 - rules.test_probability))
    significant = after - before > needed * math.hypot(spread_before, spread_after)
    return growth, deviation, significant and growth >= 1.0 + rules.least_change


@dataclass(frozen=True, slots=True)
class _ResidualChange:
    """What is left beside the orders.

    Attributes:
        ratio: float64 ``[channels]``, now over healthy.
        changed: whether a channel's rise is significant and large.
        excess: evidence of the most significant large rise above its threshold, in nats.
    """

    ratio: Floats
    changed: bool
    excess: float

    @classmethod
    def of(cls, baseline: OrderVectors, present: OrderVectors, rules: OrderRules) -> _ResidualChange:
        from scipy.special import stdtrit  # noqa: PLC0415 - scipy takes long to import

        tiny = np.finfo(np.float64).tiny
        logs = [np.log(np.maximum(run.residual_rms, tiny)) for run in (baseline, present)]
        rise = logs[1].mean(axis=0) - logs[0].mean(axis=0)
        variance = sum((log.var(axis=0, ddof=1) for log in logs), np.zeros(baseline.channels))
        # The whole scatter of blocks, not that of their mean: bursts and wear come and go for seconds.
        freedom = min(len(baseline), len(present)) - 1
        tail = rules.test_probability / baseline.channels
        needed = float(stdtrit(freedom, 1.0 - tail))
        score = rise / np.sqrt(np.maximum(variance, 1e-12))
        large = np.exp(rise) >= rules.least_residual_ratio
        nats = np.where(large, (score**2 - needed**2) / 2.0 * np.sign(score), -np.inf)
        return cls(np.exp(rise), bool((large & (score > needed)).any()), float(nats.max()))


def _causes(
    evidence: Mapping[Cause, float], rules: OrderRules, *, growth: float, grown: bool
) -> tuple[Cause, ...]:
    """The causes of a change, the most likely first."""
    lead = evidence["unbalance"] - evidence["unmodelled"]
    if growth < 1.0 + rules.least_change or lead < -rules.margin_nats:
        return ("unmodelled",)
    if grown and lead > rules.margin_nats:
        return ("unbalance", "damping_loss")
    if lead > 0.0:
        return ("unbalance", "damping_loss", "unmodelled")
    return ("unmodelled", "unbalance", "damping_loss")


def _probabilities(
    group: tuple[OrderVerdict, ...], evidence: Mapping[Cause, float], excess: float
) -> dict[OrderVerdict, float]:
    """At the threshold, changed and unchanged are even; a change is shared out by the causes' evidence."""
    changed = 1.0 / (1.0 + math.exp(-min(max(excess, -500.0), 500.0)))
    probability: dict[OrderVerdict, float] = dict.fromkeys(
        ("normal", "unbalance", "damping_loss", "unmodelled", "small_change"), 0.0
    )
    probability["normal"] = 1.0 - changed
    if group in {("normal",), ("small_change",)}:
        probability["small_change"] = changed
        return probability
    causes: tuple[Cause, ...] = ("unbalance", "damping_loss", "unmodelled")
    if group == ("unmodelled",):
        causes = ("unmodelled",)
    most = max(evidence[cause] for cause in causes)
    weights = {cause: math.exp(max(evidence[cause] - most, -700.0)) for cause in causes}
    for cause in causes:
        probability[cause] = changed * weights[cause] / sum(weights.values())
    return probability
