"""The states of an alarm as a Mermaid diagram, drawn from the moves that the code makes.

``python -m daqsvc.alarms.diagram`` prints what stands in ``docs/alarms.md``.
"""

from __future__ import annotations

import sys

from daqsvc.alarms.states import AlarmState, moves


def state_diagram() -> str:
    """The diagram, without a fence; what only latching alarms do, and only others, says so."""
    plain, latching = moves(latching=False), moves(latching=True)
    lines = ["stateDiagram-v2", f"    [*] --> {AlarmState.NORMAL}"]
    for table, note in ((plain, "not latching"), (latching, "latching")):
        other = latching if table is plain else plain
        for (state, stimulus), after in table.items():
            if other.get((state, stimulus)) != after:
                lines.append(f"    {state} --> {after}: {stimulus} ({note})")
            elif table is plain:
                lines.append(f"    {state} --> {after}: {stimulus}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(state_diagram())
