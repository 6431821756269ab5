"""What healthy revolutions go on teaching of how 1X follows the speed, without a change among them.

A calibration of some dozens of revolutions has seen a part of a swing of the speed. Each time that half as
many revolutions more are known, the law of the speed is fitted to all of them again
(`daqsvc.rotor.synchronous.speed_law`).

A fault that grows slowly raises no alarm at first, so it is among them. It must not become the healthy state.
So the baseline stays that of its own revolutions. A law is refused if anything scatters more than it did at
first. What the speed leaves unexplained is never allowed for with more than before.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.rotor.synchronous.baseline import Calibration, learnt_again, with_law
from daqsvc.rotor.synchronous.vectors import FORWARD

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.judged import JudgedRevolution
    from daqsvc.rotor.synchronous.speed_law import SpeedLaw

    Floats = NDArray[np.float64]

_MORE = 1.5
"""Revolutions over those at the last time, at which the law is fitted again."""
_MOST = 2000
"""Revolutions that teach at most."""
_TWICE = 2.0
"""Standard deviation over that at first, beyond which revolutions are not those of one healthy machine."""
_A_LITTLE = 1.2
"""The same of what their speed leaves unexplained. A fault that grows slowly does that, too."""


class Learnt(NamedTuple):
    """What was learnt.

    Attributes:
        calibration: the healthy machine, with its new law.
        rows: all revolutions that taught it, less its baseline.
        of_baseline: how many of them, from the first on, the baseline is made of.
    """

    calibration: Calibration
    rows: list[JudgedRevolution]
    of_baseline: int


class Lessons:
    """The healthy revolutions of one rotor.

    Args:
        calibrate_revolutions: revolutions that make a baseline.
        kept: the healthy state of an earlier time, where the rotor is watched by that.
    """

    def __init__(self, calibrate_revolutions: int, kept: Calibration | None) -> None:
        self.baseline_terms: Floats = np.zeros(3)
        """Mean `speed_terms` of the revolutions that made the baseline."""
        # As the stated rotor alone predicts them. The baseline is of the first ones, or of none if kept.
        self._rows: list[JudgedRevolution] = []
        self._of_baseline = 0
        self._next = round(_MORE * calibrate_revolutions)
        self._first, self._first_terms = kept, self.baseline_terms
        self._beside = kept is not None and kept.law is not None

    def begin(self, made: Calibration, rows: Sequence[JudgedRevolution]) -> None:
        """Begin with those that a calibration was made of, as the stated rotor alone predicts them."""
        self._rows = list(rows)
        self.baseline_terms = np.mean([row.terms for row in rows], axis=0)
        self._of_baseline = len(self._rows)
        self._first, self._first_terms = made, self.baseline_terms

    def before(self, onset: int) -> None:
        """Leave out all from a revolution on: the machine has changed there."""
        self._rows = [row for row in self._rows if row.revolution < onset]

    def into_baseline(self, terms: Floats) -> None:
        """All of them are in the baseline now; their mean `speed_terms` are float64 ``[3]``."""
        self._of_baseline, self.baseline_terms = len(self._rows), terms

    def add(self, row: JudgedRevolution, present: Calibration) -> Learnt | None:
        """Take in a healthy revolution.

        Args:
            row: the revolution, less the baseline and by the law of ``present``.
            present: what is known of the healthy machine.

        Returns:
            What all of them teach; None where it is not fitted now, or nothing better came out.
        """
        assert self._first is not None  # noqa: S101 - there is a calibration, or nothing is judged healthy
        if len(self._rows) >= _MOST:
            return None
        law = present.law
        vector = row.vector + present.baseline
        if law is not None:
            vector = vector + law.predicted_um(row.terms)
        self._rows.append(replace(row, vector=vector))
        if len(self._rows) < self._next:
            return None
        self._next = round(_MORE * self._next)
        moved = np.array([one.vector for one in self._rows])
        terms = np.array([one.terms for one in self._rows])
        learnt = learnt_again(present, moved, terms, self.baseline_terms)
        if learnt is None or not _as_steady(learnt[0], self._first):
            return None
        made, steady = learnt
        if law is not None and made.law is not None:
            if self._beside and not _surer(made.law, law, terms):
                return None  # what was kept may be of more revolutions than these
            made = replace(made, law=made.law.within(law))
        vectors = zip(self._rows, steady - made.baseline, strict=True)
        return Learnt(made, [replace(one, vector=vector) for one, vector in vectors], self._of_baseline)

    def kept(self, present: Calibration) -> Calibration:
        """The healthy machine for another start: its own baseline, and what was learnt of its speed since.

        The baseline grows on a return to health, and then a change that came and went may have a part in it.

        Args:
            present: what is known of it now.
        """
        made = with_law(self._first or present, present.law, self._first_terms)
        return replace(made, variance=present.variance)


def _as_steady(made: Calibration, first: Calibration) -> bool:
    """Whether a machine scatters as it did at first. One that scatters more has changed, or does slowly."""
    allowed = _TWICE**2 * first.variance
    if first.law is not None:
        allowed = np.maximum(allowed, (_A_LITTLE * first.law.off_um) ** 2)
    off = 0.0 if made.law is None else made.law.off_um**2
    return bool(np.all(np.maximum(made.variance, off) <= allowed))


def _surer(law: SpeedLaw, before: SpeedLaw, terms: Floats) -> bool:
    """Whether a law leaves less uncertain than one of before, at these `speed_terms`, float64 ``[R, 3]``."""
    apart = terms - terms.mean(axis=0)
    now, then = (float(one.variance_um2(apart)[:, FORWARD].mean()) for one in (law, before))
    return now < then
