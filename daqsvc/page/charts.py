"""How every figure of the page looks: Bokeh figures with named sources, which the browser fills."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from bokeh.models import ColumnDataSource, CrosshairTool, DataRange1d, HoverTool
from bokeh.plotting import figure

if TYPE_CHECKING:
    from collections.abc import Sequence

SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Colours of lines that people with colour blindness can distinguish, too (Okabe and Ito 2008)."""


class Theme(NamedTuple):
    """Colours of a figure.

    Attributes:
        background: behind it.
        text: of axes and legends.
        grid: of the lines behind.
        quiet: of what only helps to read it, such as the circle of the clearance.
        series: of the lines, the first one first.
    """

    background: str
    text: str
    grid: str
    quiet: str
    series: tuple[str, ...]


LIGHT = Theme("#ffffff", "#333a40", "#e3e6e8", "#8a939b", SERIES)
DARK = Theme(
    "#1b1f23",
    "#c8d0d6",
    "#30363c",
    "#78828a",
    ("#56b4e9", "#e69f00", "#35c490", "#cc79a7", "#f0e442", "#ff7f4d"),
)
THEMES = {"light": LIGHT, "dark": DARK}


DASHES = ("solid", "dashed", "dotted")


def stroke(theme: Theme, number: int) -> dict[str, str]:
    """How the line of a number is drawn: no two of up to 18 look the same, nor to who sees no colours."""
    turn, colour = divmod(number, len(theme.series))
    return {"line_color": theme.series[colour], "line_dash": DASHES[turn % len(DASHES)]}


class ChartAxis(NamedTuple):
    """What an axis shows.

    Attributes:
        label: with its unit.
        lowest: where it begins; None to follow the data.
        highest: where it ends.
        log: whether it is logarithmic.
    """

    label: str
    lowest: float | None = None
    highest: float | None = None
    log: bool = False


def chart(
    x: ChartAxis,
    y: ChartAxis,
    theme: Theme,
    *,
    height: int = 320,
    tips: Sequence[tuple[str, str]] = (),
    is_round: bool = False,
) -> Any:
    """A figure that can be panned, zoomed and read by a cursor.

    Args:
        x: its lower axis.
        y: its left one.
        theme: its colours.
        height: in pixels; the width follows the window.
        tips: what the cursor states about a point, by Bokeh's notation.
        is_round: a length along x is as long along y.
    """
    options: dict[str, Any] = {}
    for name, axis in (("x", x), ("y", y)):
        if axis.lowest is not None and axis.highest is not None:
            options[f"{name}_range"] = (axis.lowest, axis.highest)
        elif axis.lowest is not None:
            options[f"{name}_range"] = DataRange1d(start=axis.lowest)
        if axis.log:
            options[f"{name}_axis_type"] = "log"
    # As long along x as along y, it is as wide as it is high.
    shape: dict[str, Any] = (
        {"aspect_ratio": 1, "max_width": height, "sizing_mode": "scale_width"}
        if is_round
        else {"height": height, "sizing_mode": "stretch_width"}
    )
    made = figure(
        tools="pan,wheel_zoom,box_zoom,reset,save",
        active_drag="box_zoom",
        match_aspect=is_round,
        x_axis_label=x.label,
        y_axis_label=y.label,
        background_fill_color=theme.background,
        border_fill_color=theme.background,
        outline_line_color=theme.grid,
        output_backend="canvas",
        **shape,
        **options,
    )
    made.toolbar.logo = None
    made.add_tools(CrosshairTool(line_color=theme.quiet, line_alpha=0.6))
    if tips:
        made.add_tools(HoverTool(tooltips=list(tips), mode="mouse" if is_round else "vline"))
    for axis in (*made.xaxis, *made.yaxis):
        axis.axis_label_text_color = axis.major_label_text_color = theme.text
        axis.axis_label_text_font_style = "normal"
        axis.axis_line_color = axis.major_tick_line_color = theme.quiet
        axis.minor_tick_line_color = None
    for grid in made.grid:
        grid.grid_line_color = theme.grid
    return made


def source(name: str, columns: Sequence[str]) -> Any:
    """An empty source of columns, which the browser knows by its name."""
    return ColumnDataSource({column: [] for column in columns}, name=name)


def step_lines(made: Any, data: Any, names: Sequence[str], theme: Theme) -> None:
    """A line for each of some names that keeps its value until the next time.

    Args:
        made: the figure.
        data: its source, with the times in column ``t`` and the values in ``m0``, ``m1`` and so on.
        names: in the legend.
        theme: its colours.
    """
    for number, name in enumerate(names):
        look = stroke(theme, number)
        made.step("t", f"m{number}", source=data, line_width=2, mode="after", legend_label=name, **look)


def legend(made: Any, theme: Theme) -> None:
    """Make the legend of a figure quiet; a click on an entry hides its line."""
    for one in made.legend:
        one.background_fill_alpha = 0.0
        one.border_line_alpha = 0.0
        one.label_text_color = theme.text
        one.label_text_font_size = "12px"
        one.click_policy = "hide"
        one.orientation = "horizontal"
        one.padding = one.margin = 2
    if made.legend:
        made.add_layout(made.legend[0], "above")
