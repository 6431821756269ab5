"""All views of a machine, in the order in which the page shows them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.page.views.envelope import EnvelopeSpectrumView
from daqsvc.page.views.evidence import EvidenceView
from daqsvc.page.views.modes import ModesView
from daqsvc.page.views.orbit import OrbitView
from daqsvc.page.views.position import CentrelineView, PoincareView
from daqsvc.page.views.run_up import BodeView, PolarView
from daqsvc.page.views.spectrum import FullSpectrumView, SpectrumView
from daqsvc.page.views.timebase import TimebaseView
from daqsvc.page.views.trend import TrendView
from daqsvc.page.views.waterfall import WaterfallView

if TYPE_CHECKING:
    from daqsvc.page.views.view import MachineView

VIEWS: dict[str, MachineView] = {
    view.name: view
    for view in (
        ModesView(),
        EvidenceView(),
        OrbitView(),
        CentrelineView(),
        PoincareView(),
        TimebaseView(),
        SpectrumView(),
        FullSpectrumView(),
        EnvelopeSpectrumView(),
        WaterfallView(),
        BodeView(),
        PolarView(),
        TrendView(),
    )
}
"""By the name in the address."""
