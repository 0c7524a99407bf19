"""Charts as PNG bytes; the only file that knows matplotlib, and it imports it when needed."""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cvtgs.errors import InvalidArgumentError, MissingDependencyError

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
"""Okabe and Ito 2008: told apart with any colour vision."""

STYLES = ("-", "--", ":")
"""Further series take the colours again, in the next style."""

DPI = 100
SMALLEST_SIDE = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """One line.

    Attributes:
        name: What the legend calls it; series of one name look alike in every panel.
        x: Where its points are.
        y: Their values; the line has gaps where they are not finite.
        markers: Whether its points are marked.
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    markers: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """One pair of axes.

    Attributes:
        series: At least one.
        title: Stands above.
        x_label: What x is, with its unit.
        y_label: What y is, with its unit.
        x_ticks: Where to mark the x axis; empty leaves it to matplotlib.
        log_x: Whether the x axis is logarithmic.
        log_y: Whether the y axis is logarithmic.
    """

    series: Sequence[Series]
    title: str = ""
    x_label: str = ""
    y_label: str = ""
    x_ticks: Sequence[float] = ()
    log_x: bool = False
    log_y: bool = False


def line_chart(
    panels: Sequence[Panel],
    *,
    columns: int = 2,
    share_y: bool = False,
    width: int = 1000,
    height: int = 500,
) -> bytes:
    """Draw panels of lines under one legend.

    Args:
        panels: Row by row.
        columns: Panels next to one another.
        share_y: Whether the panels of a row have the same y axis.
        width: Pixels per row, at least 100.
        height: Rows, at least 100.

    Returns:
        A PNG file; the same arguments give the same bytes with the same matplotlib.

    Raises:
        InvalidArgumentError: There is nothing to draw, a series has not as many x as y, the size
            is too small, or a value does not fit its logarithmic axis.
        MissingDependencyError: matplotlib is not installed.

    Example:
        >>> loss = Series(name="loss", x=[0, 1, 2], y=[1.0, 0.5, 0.4])
        >>> line_chart([Panel(series=[loss], x_label="step")], width=400, height=300)[1:4]
        b'PNG'
    """
    _check(panels, columns, size=(width, height))
    figure = _figure(width / DPI, height / DPI)
    styles = _styles(panels)
    rows, across = math.ceil(len(panels) / columns), min(columns, len(panels))
    grid = figure.subplots(rows, across, squeeze=False, sharey="row" if share_y else False).flat
    lines: dict[str, Any] = {}
    for panel, axes in zip(panels, grid, strict=False):
        lines |= _draw(axes, panel, styles)
    for axes in list(grid)[len(panels) :]:
        axes.set_visible(False)
    if len(lines) > 1:
        figure.legend(
            list(lines.values()),
            list(lines),
            loc="outside lower center",
            ncols=min(len(lines), 6),
            frameon=False,
        )
    file = io.BytesIO()
    figure.canvas.print_png(file, metadata={"Software": None})
    return file.getvalue()


def _figure(width: float, height: float) -> Any:
    """Make a figure that belongs to no window and no global list; inches."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 (optional)
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError as error:
        raise MissingDependencyError(
            "charts need matplotlib, which is not installed; "
            "install it with: pip install 'cvtgs[plots]'."
        ) from error
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _styles(panels: Sequence[Panel]) -> dict[str, dict[str, str]]:
    """Give every name a look of its own, in the order of appearance."""
    names = dict.fromkeys(series.name for panel in panels for series in panel.series)
    return {
        name: {
            "color": COLORS[number % len(COLORS)],
            "linestyle": STYLES[number // len(COLORS) % len(STYLES)],
        }
        for number, name in enumerate(names)
    }


def _draw(axes: Any, panel: Panel, styles: dict[str, dict[str, str]]) -> dict[str, Any]:
    lines = {}
    for series in panel.series:
        y = [value if math.isfinite(value) else math.nan for value in series.y]
        marker = "o" if series.markers or len(y) == 1 else None
        (lines[series.name],) = axes.plot(series.x, y, marker=marker, **styles[series.name])
    axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
    if panel.log_x:
        axes.set_xscale("log")
    if panel.log_y:
        axes.set_yscale("log")
    if panel.x_ticks:
        axes.set_xticks(panel.x_ticks, [f"{tick:g}" for tick in panel.x_ticks])
        axes.set_xticks([], minor=True)
    axes.grid(visible=True, color="#DDDDDD", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return lines


def _check(panels: Sequence[Panel], columns: int, *, size: tuple[int, int]) -> None:
    if columns < 1 or min(size) < SMALLEST_SIDE:
        raise InvalidArgumentError(
            f"a chart must have at least 1 column and {SMALLEST_SIDE} pixels on each side, "
            f"found {columns} and {size[0]} x {size[1]}."
        )
    if not panels:
        raise InvalidArgumentError("a chart needs at least one panel, found none.")
    for panel in panels:
        if not panel.series:
            raise InvalidArgumentError(
                f"every panel needs at least one series, found none in {panel.title!r}."
            )
        for series in panel.series:
            _check_series(series, panel)


def _check_series(series: Series, panel: Panel) -> None:
    if len(series.x) != len(series.y) or len(series.x) == 0:
        raise InvalidArgumentError(
            f"series {series.name!r} must have as many x as y, and at least one; "
            f"found {len(series.x)} and {len(series.y)}."
        )
    for axis, is_log, values in (("x", panel.log_x, series.x), ("y", panel.log_y, series.y)):
        bad = [number for number, value in enumerate(values) if value <= 0] if is_log else []
        if bad:
            raise InvalidArgumentError(
                f"series {series.name!r} must be above 0 on the logarithmic {axis} axis; "
                f"{len(bad)} values are not, the first is {axis}[{bad[0]}] = {values[bad[0]]:g}."
            )
