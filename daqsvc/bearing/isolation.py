"""Which race, by likelihood: which race explains every impact better.

The residual is cut into frames about as long as one impact. In frame t and line f of its spectrum, the
healthy machine has the covariance S_0(f); an impact of race i adds a s(f) M_i(f). There a is the size of the
impact, s the spectrum of a short dip, and M_i the second moment of the race's answer over models that are
wrong by the stated mismatch. Lines in which the two races look alike to such models then have no weight. The
logarithm of the likelihood, each race at its best a, gives for each frame a ratio d of inner over outer race
in nats, of which what noise alone does is taken off. Under a fault of one race all frames that decide are of
one side; a ball strikes the races in turn, and they are of both. So the rule is one of ratio again: that of
the evidence for the inner race to that for either.

Against energies of the two components this gains much where the races look nearly alike: the noises of the
two components are then nearly one, and cancel in d.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from daqsvc.bearing import impact
from daqsvc.bearing.model import INNER, OUTER, BearingModel, BearingParameters
from daqsvc.bearing.residual import CORNER_HZ

if TYPE_CHECKING:
    from daqsvc.bearing.impact import HealthySpectrum
    from daqsvc.bearing.model import Complexes, Floats
    from daqsvc.bearing.sliding_mode import Race

FRAME_S = 128 / 48_000
"""Length of a frame: an impact, and little of the next."""
LOWEST_PER_BALL_MODE, LOWEST_TELLING_HZ = 0.2, 600.0
"""Lines below this share of the rolling elements' mode cannot tell the races apart."""
HIGHEST_PER_NYQUIST = 2.0 / 3.0
STANDS_OUT_NATS = 4.0
"""A frame counts as an impact if it is this much likelier with one than without."""
OF_THE_LARGE = 0.1
"""And at least by this share of what the large impacts are: the ringing after an impact, which a slightly
wrong model leaves, looks like small impacts of the other race."""
DECIDES_NATS = 2.0
"""Taken off the ratio of every frame: noise alone makes frames lean to either side by as much."""
OUTER_BELOW, INNER_ABOVE = 0.32, 0.93
"""Shares of the evidence for the inner race that bound a ball's."""
LEAST_NATS_PER_S = 165.0
"""Evidence in a second below which the verdict is left open: a wrong model's does not average out."""
DOUBT = 0.05
"""A share this near to a boundary leaves the parts on both sides of it possible."""
_DRAWS = 200
_SIZES = np.append(0.0, 10.0 ** np.arange(-1.5, 6.1, 0.3))
_SMALLEST = 0.01


@dataclass(frozen=True, slots=True)
class Isolation:
    """What a window states about a fault that has been detected.

    Attributes:
        verdict: the faulty part; ``"ball"`` is also what inner and outer race together look like, and
            ``"inner_or_outer"`` states that the evidence does not decide.
        group: the parts that the evidence leaves possible, the verdict first.
        inner_nats: evidence of the frames that are likelier to be impacts of the inner race.
        outer_nats: evidence of the others.
        hits: frames in which an impact stands out.
    """

    verdict: Race | Literal["inner_or_outer"]
    group: tuple[Race, ...]
    inner_nats: float
    outer_nats: float
    hits: int


def least_rate_hz(parameters: BearingParameters) -> float:
    """Sampling rate above which any line tells the races of a bearing apart."""
    return 2.0 / HIGHEST_PER_NYQUIST * _lowest_hz(BearingModel(parameters))


def isolation_spectrum(residual: Floats, rate_hz: float) -> HealthySpectrum:
    """What `IsolationRule` has to know of the healthy machine.

    Args:
        residual: float64 ``[n, 2]``, of the healthy machine with the usual corner, in m/s^2; frames with NaN
            are left out.
        rate_hz: sampling rate.

    Raises:
        ValueError: the residual is too short.
    """
    frame, _, kept = short_lines(rate_hz)
    return impact.healthy_spectrum(residual, rate_hz, frame, kept, 4 * frame, "isolation")


class IsolationRule:
    """Judges windows of the residual of `daqsvc.bearing.residual.TwoSensorResidual` with its usual corner.

    Args:
        parameters: of the healthy bearing.
        rate_hz: sampling rate.
        healthy: of the healthy machine, by `isolation_spectrum`.
        mismatch: share by which each parameter may be wrong.
        seed: of the models that are drawn.

    Attributes:
        lines_hz: frequencies that tell the races apart; none if the sampling rate is too low for this
            bearing, and then every verdict is ``"inner_or_outer"``.

    Raises:
        ValueError: the mismatch is not between 0 and 0.5, or the spectrum of another rate.
    """

    def __init__(
        self,
        parameters: BearingParameters,
        rate_hz: float,
        healthy: HealthySpectrum,
        *,
        mismatch: float = 0.1,
        seed: int = 0,
    ) -> None:
        if not 0.0 <= mismatch < 0.5:
            raise ValueError(f"bearing isolation: a mismatch of {mismatch:g}; it must be from 0 to 0.5")
        model = BearingModel(parameters)
        self._frame, frequency_hz, self._kept = short_lines(rate_hz)
        if len(healthy.covariance) != len(frequency_hz):
            raise ValueError(
                f"bearing isolation: a healthy spectrum of {len(healthy.covariance)} lines; there are "
                f"{len(frequency_hz)} at {rate_hz:g} samples a second: learn it at this rate"
            )
        telling = frequency_hz > _lowest_hz(model)
        self._kept[self._kept] = telling
        self.lines_hz: Floats = frequency_hz[telling]
        self._step_s = self._frame / 2.0 / rate_hz
        self._to_displacement = 1.0 / np.diag(model.D)
        if len(self.lines_hz):
            noise = healthy.covariance[telling] * np.outer(self._to_displacement, self._to_displacement)
            self._weigh(model, noise, mismatch, np.random.default_rng(seed))

    def _weigh(
        self, model: BearingModel, noise: Complexes, mismatch: float, rng: np.random.Generator
    ) -> None:
        """Quadratic forms of the log-likelihood of every race and size, over all lines at once."""
        moments = _moments(model, self.lines_hz, mismatch, rng)
        dip = impact.power(self.lines_hz, CORNER_HZ)
        smallest = _SMALLEST * float(np.median(np.trace(noise, axis1=1, axis2=2).real / dip))
        hits = (_SIZES * smallest)[:, None, None, None, None] * dip[:, None, None] * moments[None]
        precision = np.linalg.inv(noise + hits)
        self._normaliser = np.log(np.linalg.det(noise + hits).real).sum(axis=-1)
        cross = precision[..., 0, 1]
        self._forms = np.concatenate(
            (precision[..., 0, 0].real, precision[..., 1, 1].real, 2.0 * cross.real, -2.0 * cross.imag),
            axis=-1,
        )

    def judge(self, residual: Floats) -> Isolation:
        """Name the faulty part.

        Args:
            residual: float64 ``[n, 2]`` in m/s^2, of a window in which a fault was detected; frames with NaN
                are left out.
        """
        spectra = impact.spectra(residual, self._frame)[:, self._kept] * self._to_displacement
        inner, outer, hits = self._evidence(spectra)
        total = inner + outer
        everything: tuple[Race, ...] = ("inner", "outer", "ball")
        # Half-overlapping frames are half a frame longer than they are many.
        if total < LEAST_NATS_PER_S * self._step_s * (len(spectra) + 1):
            return Isolation("inner_or_outer", everything, inner, outer, hits)
        share = inner / total
        verdict: Race = "outer" if share < OUTER_BELOW else "inner" if share > INNER_ABOVE else "ball"
        neighbours: dict[Race, bool] = {
            "outer": share < OUTER_BELOW + DOUBT,
            "inner": share > INNER_ABOVE - DOUBT,
            "ball": OUTER_BELOW - DOUBT < share < INNER_ABOVE + DOUBT,
        }
        others = tuple(race for race, near in neighbours.items() if near and race != verdict)
        return Isolation(verdict, (verdict, *others), inner, outer, hits)

    def _evidence(self, spectra: Complexes) -> tuple[float, float, int]:
        """Nats for the inner and for the outer race, and the number of impacts."""
        if not len(spectra) or not len(self.lines_hz):
            return 0.0, 0.0, 0
        cross = spectra[..., 0].conj() * spectra[..., 1]
        products = (*np.abs(spectra.transpose(2, 0, 1)) ** 2, cross.real, cross.imag)
        likelihood = -np.tensordot(np.concatenate(products, axis=1), self._forms, (1, 2)) - self._normaliser
        gain = likelihood.max(axis=1) - likelihood[:, 0]
        stands_out = gain.max(axis=1)
        hits = stands_out > STANDS_OUT_NATS
        if not hits.any():
            return 0.0, 0.0, 0
        gain = gain[stands_out > max(STANDS_OUT_NATS, OF_THE_LARGE * np.percentile(stands_out[hits], 95.0))]
        ratio = gain[:, INNER] - gain[:, OUTER]
        inner, outer = (np.maximum(side - DECIDES_NATS, 0.0).sum() for side in (ratio, -ratio))
        return float(inner), float(outer), len(ratio)


def short_lines(rate_hz: float) -> tuple[int, Floats, impact.Mask]:
    """See `impact.frame_lines`, of frames as long as an impact."""
    return impact.frame_lines(rate_hz, FRAME_S, HIGHEST_PER_NYQUIST)


def _lowest_hz(model: BearingModel) -> float:
    return max(LOWEST_PER_BALL_MODE * float(model.modes_hz[2]), LOWEST_TELLING_HZ)


def _moments(
    model: BearingModel, frequency_hz: Floats, mismatch: float, rng: np.random.Generator
) -> Complexes:
    """Second moments of what a unit impact of either race looks like, complex128 ``[race, f, 2, 2]``."""
    nominal = np.linalg.inv(model.fault_transfer_by_stiffness(frequency_hz))
    moments = np.zeros((2, len(frequency_hz), 2, 2), dtype=np.complex128)
    figures = asdict(model.parameters)
    for _ in range(_DRAWS):
        off = 1.0 + mismatch * rng.uniform(-1.0, 1.0, len(figures))
        drawn = BearingParameters(
            **{name: value * x for (name, value), x in zip(figures.items(), off, strict=True)}
        )
        seen = nominal @ BearingModel(drawn).fault_transfer_by_stiffness(frequency_hz)
        moments += np.einsum("fir,fjr->rfij", seen, seen.conj()) / _DRAWS
    return np.asarray(moments)
