"""A line of the envelope is told as one part's only."""

from __future__ import annotations

from support.bearing_signals import CAGE, INNER, OUTER, RATE_HZ, SPEED_RPM, Housing

from daqsvc.bearing.geometry import BearingOrders
from daqsvc.bearing.race import race_test
from daqsvc.bearing.race.lines import EXPLAINED_SHARE, part_lines


def test_no_line_of_another_part_is_where_the_foremost_part_has_one() -> None:
    # The ball's line is put beside a sideband of the inner race's.
    bearing = BearingOrders(inner=INNER, outer=OUTER, ball=(INNER - 1.0) / 2.0, cage=CAGE)
    samples = Housing(order=INNER, size=1.5, seed=3).samples
    verdict = race_test(samples, RATE_HZ, SPEED_RPM, bearing)
    assert verdict.verdict == "inner"
    assert sum(line.part == "inner" for line in verdict.lines) >= 8
    explained = part_lines("inner", verdict.evidence["inner"].order, bearing)
    others = [line.order for line in verdict.lines if line.part != "inner"]
    assert not [order for order in others for own in explained if abs(order / own - 1.0) < EXPLAINED_SHARE]
