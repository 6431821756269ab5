"""What ``daqsvc analyze --json`` prints beside the first verdict; apart, as its types bring much of SciPy."""

from __future__ import annotations

from typing import NotRequired, TypedDict

from daqsvc.detectors.bearing.verdict import BearingVerdictJson  # noqa: TC001 - the page of formats reads the types
from daqsvc.diagnosis.recorded import StatementsJson  # noqa: TC001 - as above


class OtherParts(TypedDict):
    """What comes with the verdict about the first part of the machine.

    Attributes:
        bearing: the verdict about the bearings, if the first one is about the rotor.
        detectors: by detector its statements.
    """

    bearing: NotRequired[BearingVerdictJson]
    detectors: NotRequired[dict[str, StatementsJson]]
