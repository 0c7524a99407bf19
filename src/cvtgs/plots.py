"""Charts as PNG bytes; the only file that imports matplotlib, and it does so lazily."""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle, product
from typing import Any

import numpy as np

from cvtgs.errors import MissingDependencyError, how_to_install

# Palette of Okabe and Ito 2008, distinct with any colour vision. When the colours are used up, they
# repeat in the next style; when the styles are used up too, points are marked, in the next shape.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
STYLES = ("-", "--", ":")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<")
DPI = 100

# Offsets of a label to the right and up of the point, in typographic points, and its alignments.
_LABEL_POSITIONS = (
    (0, 7, "center", "bottom"),
    (0, -7, "center", "top"),
    (7, 0, "left", "center"),
    (-7, 0, "right", "center"),
    (6, 6, "left", "bottom"),
    (6, -6, "left", "top"),
    (-6, 6, "right", "bottom"),
    (-6, -6, "right", "top"),
)

Extents = tuple[float, float, float, float]  # left, lower, right and upper edges in pixels


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """One line; it has gaps where ``y`` is not finite."""

    name: str  # series of one name share a style in all panels
    x: Sequence[float]
    y: Sequence[float]
    markers: bool = False
    labels: Sequence[str] = ()  # texts at the points
    hollow: Sequence[bool] = ()  # points beside the line


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """One pair of axes; matplotlib chooses the ticks if none are given."""

    series: Sequence[Series]
    title: str = ""
    x_label: str = ""
    y_label: str = ""
    x_ticks: Sequence[float] = ()
    log_x: bool = False


def line_chart(
    panels: Sequence[Panel],
    *,
    columns: int = 2,
    share_y: bool = False,
    width: int = 1000,
    height: int = 500,
) -> bytes:
    """Draw panels of lines, row by row and under one legend, as a PNG file."""
    figure = _figure(width / DPI, height / DPI)
    styles = _styles(panels)
    rows, across = math.ceil(len(panels) / columns), min(columns, len(panels))
    places = figure.subplots(rows, across, squeeze=False, sharey="row" if share_y else False)
    grid = list(places.flat)
    lines: dict[str, Any] = {}
    for panel, axes in zip(panels, grid, strict=False):
        lines |= _draw(axes, panel, styles)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    if len(lines) > 1:
        figure.legend(
            list(lines.values()),
            list(lines),
            loc="outside lower center",
            ncols=max(1, min(len(lines), 6, width // (8 * max(map(len, lines)) + 70))),
            frameon=False,
        )
    if any(series.labels for panel in panels for series in panel.series):
        figure.draw_without_rendering()  # the layout moves the axes, and labels with them
        for panel, axes in zip(panels, figure.axes, strict=False):
            _write_labels(axes, panel)
    file = io.BytesIO()
    figure.canvas.print_png(file, metadata={"Software": None})
    return file.getvalue()


def _figure(width: float, height: float) -> Any:
    """Return a figure of a size in inches, without a window and outside pyplot's global state."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 (optional)
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError as error:
        raise MissingDependencyError(
            f"charts need matplotlib, which is not installed; {how_to_install('cvtgs[plots]')}."
        ) from error
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _styles(panels: Sequence[Panel]) -> dict[str, dict[str, str]]:
    """Return a style for every name, assigned in order of appearance."""
    names = dict.fromkeys(series.name for panel in panels for series in panel.series)
    styles = [
        {"color": color, "linestyle": style, "marker": marker}
        for marker, style, color in product(MARKERS, STYLES, COLORS)
    ]
    return dict(zip(names, cycle(styles), strict=False))


def _draw(axes: Any, panel: Panel, styles: dict[str, dict[str, str]]) -> dict[str, Any]:
    lines = {}
    for series in panel.series:
        style = dict(styles[series.name])
        if not series.markers and len(series.y) > 1 and style["marker"] == MARKERS[0]:
            del style["marker"]
        x, y = np.array(series.x), np.array(series.y, dtype=np.float64)
        y[~np.isfinite(y)] = np.nan
        hollow = np.array(series.hollow or [False] * len(y))
        (lines[series.name],) = axes.plot(x[~hollow], y[~hollow], **style)
        if hollow.any():
            style |= {"linestyle": "", "marker": styles[series.name]["marker"]}
            axes.plot(x[hollow], y[hollow], mfc="white", **style)
    axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
    if panel.log_x:
        axes.set_xscale("log")
    if any(series.labels for series in panel.series):
        axes.margins(0.08, 0.12)  # before the ticks, which may widen the axis
    if panel.x_ticks:
        axes.set_xticks(panel.x_ticks, [f"{tick:g}" for tick in panel.x_ticks])
        axes.set_xticks([], minor=True)
    axes.grid(visible=True, color="#DDDDDD", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return lines


def _write_labels(axes: Any, panel: Panel) -> None:
    """Write each label where it covers the least of the points and the other labels."""
    points = [
        (label, (x, y))
        for series in panel.series
        for label, x, y in zip(
            series.labels or [""] * len(series.x), series.x, series.y, strict=True
        )
        if math.isfinite(y)
    ]
    middles = [axes.transData.transform(point) for _, point in points]
    taken = [(x - 4, y - 4, x + 4, y + 4) for x, y in middles]
    frame = axes.get_window_extent().extents
    for label, point in points:
        if label:
            text = axes.annotate(
                label, point, xytext=(0, 0), textcoords="offset points", fontsize=8, color="#444444"
            )
            text.set_bbox({"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 0.5})
            costs = [
                _cost(_put(text, number), taken, frame) + number
                for number in range(len(_LABEL_POSITIONS))
            ]
            taken.append(_put(text, costs.index(min(costs))))


def _put(text: Any, number: int) -> Extents:
    """Move a label to one of its positions, and return its extents there."""
    right, up, horizontal, vertical = _LABEL_POSITIONS[number]
    text.xyann = (right, up)
    text.set(horizontalalignment=horizontal, verticalalignment=vertical)
    x0, y0, x1, y1 = text.get_window_extent().extents
    return x0, y0, x1, y1


def _cost(box: Extents, taken: Sequence[Extents], frame: Extents) -> float:
    """Return the area that a label covers of others, plus its area outside the frame, in pixels."""
    outside = _shared(box, box) - _shared(box, frame)
    return outside + sum(_shared(box, other) for other in taken)


def _shared(one: Extents, other: Extents) -> float:
    """Return the area of the intersection of two boxes, square pixels."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    return max(0.0, width) * max(0.0, height)
