"""The race test on a running machine: window after window, evidence gathered over the last ten seconds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.race.judge import race_features, verdict_of
from daqsvc.bearing.race.rules import RaceRules

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.baseline import RaceBaseline
    from daqsvc.bearing.race.verdict import RaceVerdict

WINDOW_S = 2.5
SPAN_S = 10.0


class RaceWatch:
    """Race test of consecutive windows: the last `SPAN_S` seconds are judged together; memory stays flat.

    Args:
        rate_hz: sample rate of the windows.
        speed_rpm: stated speed of the shaft.
        bearing: its fault orders.
        rules: settings of the test.
        baseline: of the same machine in good order.
    """

    def __init__(
        self,
        rate_hz: float,
        speed_rpm: float,
        bearing: BearingOrders,
        rules: RaceRules | None = None,
        baseline: RaceBaseline | None = None,
    ) -> None:
        self.rate_hz = rate_hz
        self.speed_rpm = speed_rpm
        self.window = round(WINDOW_S * rate_hz)
        self._bearing = bearing
        self._rules = rules or RaceRules()
        self._baseline = baseline
        self._held: NDArray[np.float64] = np.empty(0)
        self._span = round(SPAN_S * rate_hz)

    def evaluate(self, window_samples: NDArray[np.floating], speed_rpm: float | None = None) -> RaceVerdict:
        """Take in the next window and judge the last ten seconds.

        Args:
            window_samples: ``[n]``, about `window` samples that follow those before; call `forget` where they
                do not.
            speed_rpm: the shaft's speed now, if it is measured; a change of more than the tolerance of the
                test begins anew.

        Raises:
            UnfitError: no verdict can rest on these samples. They are forgotten.
        """
        if speed_rpm is not None:
            if abs(speed_rpm / self.speed_rpm - 1.0) > self._rules.speed_tolerance:
                self.forget()
            self.speed_rpm = speed_rpm
        joined = np.concatenate((self._held, np.asarray(window_samples, dtype=np.float64)))[-self._span :]
        self._held = np.empty(0)
        features = race_features(joined, self.rate_hz, self.speed_rpm, self._bearing, self._rules)
        self._held = joined
        return verdict_of(features, self._rules, self._baseline)

    def forget(self) -> None:
        """Begin anew: samples are missing, or the machine has changed."""
        self._held = np.empty(0)
