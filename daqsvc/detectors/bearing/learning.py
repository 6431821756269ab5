"""The healthy machine out of the first seconds in which the bearings' detector finds nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.baseline import learn_baseline
from daqsvc.bearing.identify import NotIdentifiableError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.baseline import BearingBaseline
    from daqsvc.detectors.bearing.finding import BearingFinding
    from daqsvc.detectors.bearing.housed import HousedBearing


class HealthyGathering:
    """Gathers looks at a machine in good order until the healthy machine can be learnt of them.

    Args:
        bearings: the bearings.
        rate_hz: sampling rate.
        calibrate_s: how much is needed.
    """

    def __init__(self, bearings: Sequence[HousedBearing], rate_hz: float, calibrate_s: float) -> None:
        self._bearings = bearings
        self._rate_hz = rate_hz
        self._needed = round(calibrate_s * rate_hz)
        self._gathered: list[NDArray[np.float32]] = []
        self._refused = ""

    @property
    def reason(self) -> str:
        """Why there is no healthy machine yet, for a person."""
        if self._refused:
            return f'no healthy state to tell "changed" by: {self._refused}'
        gathered = sum(map(len, self._gathered)) / self._rate_hz
        return f"learning the healthy state: {gathered:.0f} of {self._needed / self._rate_hz:.0f} s"

    def add(
        self, samples: NDArray[np.float32], finding: BearingFinding, speed_rpm: float
    ) -> BearingBaseline | None:
        """Take in a look that follows those before.

        Args:
            samples: float32 ``[n, channels]`` of the stream.
            finding: what it has shown; one that shows a fault is not taken, and those before are forgotten.
            speed_rpm: speed of the shaft.

        Returns:
            The healthy machine, when there is enough of it.
        """
        if finding.verdict != "normal":
            self._gathered = []
            self._refused = f"the machine shows {finding.verdict.replace('_', ' ')} at {finding.where}"
            return None
        self._gathered.append(samples)
        if sum(map(len, self._gathered)) < self._needed:
            return None
        together = np.concatenate(self._gathered).astype(np.float64)
        self._gathered = []
        together[~np.isfinite(together)] = np.nan
        try:
            learnt = learn_baseline(
                {
                    name: together[:, column]
                    for bearing in self._bearings
                    for name, column in zip(bearing.sensors, bearing.columns, strict=True)
                },
                self._rate_hz,
                speed_rpm,
                {bearing.sensor: bearing.orders for bearing in self._bearings},
                [bearing.sensors for bearing in self._bearings],
                pairs={b.sensors: b.two.model for b in self._bearings if b.two is not None},
                source="the running service",
            )
        except NotIdentifiableError as error:
            self._refused = str(error)
            return None
        self._refused = ""
        return learnt

    def forget(self) -> None:
        """Looks before do not belong to those after."""
        self._gathered = []
