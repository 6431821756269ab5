"""The states of an alarm and what moves it, from the moves that the code makes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

from daqsvc.alarms.states import HOLDS, AlarmState, Hold, Stimulus, moves, strongest_first
from make_pictures.style import FAULTY, GOOD, HEALTHY, QUIET, arrow, blank, box, new

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLACES = {
    AlarmState.NORMAL: (90.0, 300.0),
    AlarmState.ACTIVE_UNACKNOWLEDGED: (350.0, 300.0),
    AlarmState.ACTIVE_ACKNOWLEDGED: (610.0, 300.0),
    AlarmState.RETURNED_UNACKNOWLEDGED: (90.0, 120.0),
    AlarmState.LATCHED_UNACKNOWLEDGED: (350.0, 120.0),
    AlarmState.LATCHED_ACKNOWLEDGED: (610.0, 120.0),
}
"""Where each state is drawn; a state of the code that has no place here ends the script."""
SIZE = (128.0, 46.0)
Kind = Literal["both", "latching", "plain"]
"""Of which alarms a move is: all, those that latch, those that do not."""
COLOURS = {
    Stimulus.RAISE: FAULTY,
    Stimulus.ESCALATE: FAULTY,
    Stimulus.CLEAR: GOOD,
    Stimulus.ACKNOWLEDGE: HEALTHY,
    Stimulus.RESET: HEALTHY,
}
EDGES = {
    AlarmState.ACTIVE_UNACKNOWLEDGED: FAULTY,
    AlarmState.ACTIVE_ACKNOWLEDGED: FAULTY,
    AlarmState.NORMAL: GOOD,
}


def states() -> Figure:
    """Each state in its place, an arrow for each move; dashed what only alarms without latching do."""
    plain, latching = moves(latching=False), moves(latching=True)
    figure = new(4.4)
    axes = blank(figure, 700.0, 422.0)
    own = [state for state in AlarmState if state not in HOLDS]
    for state in own:
        title, _, rest = state.in_words.partition(" ")
        box(axes, PLACES[state], SIZE, [title, rest] if rest else [title], EDGES.get(state, QUIET))
    for (state, stimulus), after in latching.items():
        draw(axes, state, after, stimulus, "both" if plain.get((state, stimulus)) == after else "latching")
    for (state, stimulus), after in plain.items():
        if latching.get((state, stimulus)) != after:
            draw(axes, state, after, stimulus, "plain")
    axes.text(30.0, 30.0, "people: acknowledge, reset", color=HEALTHY, fontsize=9)
    axes.text(215.0, 30.0, "data: raise, escalate", color=FAULTY, fontsize=9)
    axes.text(370.0, 30.0, "data: clear", color=GOOD, fontsize=9)
    axes.text(470.0, 30.0, "dashed: only without latching", color=QUIET, fontsize=9)
    covers = ", ".join(state.in_words for state in strongest_first(list(Hold)))
    text = f"covers, strongest first; the state below is kept: {covers}"
    axes.text(30.0, 8.0, text, color=QUIET, fontsize=9)
    return figure


class Route(NamedTuple):
    """How an arrow goes.

    Attributes:
        begin: where it begins.
        end: where it ends.
        label: where its label is.
        align: on which side of that place the label's text begins.
        bend: how far it is bent.
    """

    begin: tuple[float, float]
    end: tuple[float, float]
    label: tuple[float, float]
    align: Literal["left", "center", "right"] = "center"
    bend: float = 0.0


def draw(axes: Axes, here: AlarmState, there: AlarmState, stimulus: Stimulus, kind: Kind) -> None:
    """One move, with its stimulus beside the arrow."""
    way = route(PLACES[here], PLACES[there])
    move = arrow(axes, way.begin, way.end, bend=way.bend, color=COLOURS[stimulus], dashed=kind == "plain")
    move.set_gid(f"{here}.{stimulus}.{there}.{kind}")
    axes.text(*way.label, str(stimulus), ha=way.align, va="center", fontsize=8.5, color=COLOURS[stimulus])


def route(here: tuple[float, float], there: tuple[float, float]) -> Route:
    """The way from one box to another: the two directions run beside each other."""
    (x1, y1), (x2, y2) = here, there
    half_w, half_h = SIZE[0] / 2, SIZE[1] / 2
    if y1 == y2 and abs(x1 - x2) < 300.0:  # neighbours
        side = 1.0 if x2 > x1 else -1.0
        track = y1 + 10.0 * side
        label = ((x1 + x2) / 2, track + 9.0 * side)
        return Route((x1 + side * half_w, track), (x2 - side * half_w, track), label)
    if y1 == y2:  # over the one between
        return Route((x1, y1 + half_h), (x2, y2 + half_h), ((x1 + x2) / 2, y1 + half_h + 64.0), bend=0.2)
    down = -1.0 if y2 < y1 else 1.0
    if x1 == x2:
        track = x1 - 14.0 * down
        right = down < 0 or x1 < 2 * half_w  # no room on the left of the first column
        label = (track + (5.0 if right else -5.0), (y1 + y2) / 2)
        begin, end = (track, y1 + down * half_h), (track, y2 - down * half_h)
        return Route(begin, end, label, "left" if right else "right")
    side = 1.0 if x2 > x1 else -1.0
    shift = -7.0 if down < 0 else 7.0
    far = abs(x1 - x2) > 300.0
    begin = (x1 + side * 40.0 + shift, y1 + down * half_h)
    end = (x2 - side * 40.0 + shift, y2 - down * half_h)
    share = 0.86 if far else 0.7 if down < 0 else 0.36
    at = (begin[0] + share * (end[0] - begin[0]), begin[1] + share * (end[1] - begin[1]))
    if far:
        return Route(begin, end, (at[0] + 4.0, at[1] + 11.0), "left")
    return Route(begin, end, (at[0] + (-7.0 if down < 0 else 9.0), at[1]), "right" if down < 0 else "left")
