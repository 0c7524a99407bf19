"""Charts: PNG bytes of the requested size, and clear errors."""

import importlib.util
import io
import struct
import sys

import numpy as np
import pytest
from PIL import Image

from cvtgs.errors import MissingDependencyError
from cvtgs.plots import COLORS, Panel, Series, _cost, _shared, _styles, line_chart

needs_matplotlib = pytest.mark.skipif(
    importlib.util.find_spec("matplotlib") is None, reason="matplotlib is optional"
)
LOSS = Series(name="loss", x=[0, 1, 2], y=[3.0, 2.0, 1.0])
GAIN = Series(name="gain", x=[0, 2], y=[0.1, 0.4], markers=True)


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def shows(image: np.ndarray, color: str) -> bool:
    wanted = [int(color[start : start + 2], 16) for start in (1, 3, 5)]
    return bool((image == wanted).all(axis=-1).any())


@needs_matplotlib
@pytest.mark.parametrize("size", [(100, 100), (640, 333)])
def test_the_bytes_are_a_png_of_the_requested_size(size):
    png = line_chart([Panel(series=[LOSS])], width=size[0], height=size[1])
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">II", png[16:24]) == size


@needs_matplotlib
def test_same_arguments_give_the_same_bytes():
    panels = [Panel(series=[LOSS, GAIN], title="training", x_label="step")]
    assert line_chart(panels) == line_chart(panels)


@needs_matplotlib
def test_a_name_has_one_colour_in_every_panel():
    """On its own, the second panel would use the first colour."""
    both = line_chart([Panel(series=[LOSS]), Panel(series=[GAIN])], width=800, height=300)
    left, right = np.split(pixels(both)[:240], 2, axis=1)
    assert shows(left, COLORS[0])
    assert not shows(left, COLORS[1])
    assert shows(right, COLORS[1])
    assert not shows(right, COLORS[0])


@needs_matplotlib
def test_values_that_are_not_finite_leave_a_gap():
    gappy = Series(name="loss", x=[1, 2, 3, 4], y=[1.0, float("nan"), float("inf"), 2.0])
    assert line_chart([Panel(series=[gappy])])
    nothing = Series(name="loss", x=[1], y=[float("nan")])
    assert line_chart([Panel(series=[nothing])])


@needs_matplotlib
def test_more_series_than_colours_and_fewer_panels_than_cells():
    many = [Series(name=str(number), x=[0.1, 0.01], y=[number, 1]) for number in range(20)]
    panel = Panel(series=many, x_ticks=[0.1, 0.01], log_x=True)
    assert line_chart([panel] * 3, columns=2, share_y=True, height=900)


@needs_matplotlib
def test_a_legend_of_long_names_is_whole():
    many = [Series(name=f"another tool, adaptive {k}", x=[0, 1], y=[k, 1]) for k in range(8)]
    image = pixels(line_chart([Panel(series=many)], width=1000, height=600))
    assert (image[500:, :5] == 255).all()
    assert (image[500:, -5:] == 255).all()


@needs_matplotlib
def test_a_grid_cell_without_a_panel_stays_empty():
    image = pixels(line_chart([Panel(series=[LOSS])] * 3, columns=2, width=400, height=400))
    assert (image[:200, 200:] != 255).any()
    assert (image[220:, 220:] == 255).all()


def test_a_missing_package_is_one_clear_error(monkeypatch):
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError) as caught:
        line_chart([Panel(series=[LOSS])])
    assert str(caught.value) == (
        "charts need matplotlib, which is not installed; "
        'install it with python -m pip install "cvtgs[plots]".'
    )


@needs_matplotlib
@pytest.mark.slow
def test_more_names_than_colours_and_styles_still_look_different():
    """The 25th line repeats the first colour and style, but with another marker shape."""
    names = [str(number) for number in range(25)]
    panel = Panel(series=[Series(name=name, x=[0, 1], y=[1, 1]) for name in names])
    styles = _styles([panel])
    assert len({tuple(style.items()) for style in styles.values()}) == 25
    assert styles["0"]["marker"] != styles["24"]["marker"]
    first, last = (
        line_chart([Panel(series=[*panel.series[:24], Series(name=name, x=[0, 1], y=[2, 3])])])
        for name in ("0", "24")
    )
    assert first != last


@needs_matplotlib
def test_hollow_points_are_left_out_of_the_line():
    """A line through all three points would pass below the middle of the chart."""
    line = Series(name="a", x=[0, 1, 2], y=[1, 0, 1], markers=True, hollow=[False, True, False])
    drawn = pixels(line_chart([Panel(series=[line])], width=400, height=300))
    wanted = [int(COLORS[0][start : start + 2], 16) for start in (1, 3, 5)]
    blue = (drawn == wanted).all(axis=-1)
    rows = np.flatnonzero(blue.any(axis=1))
    middle = (rows.min() + rows.max()) // 2
    assert not blue[middle - 20 : middle + 20].any()
    alone = Series(name="a", x=[1], y=[1], hollow=[True])
    assert shows(pixels(line_chart([Panel(series=[alone])])), COLORS[0])


@needs_matplotlib
@pytest.mark.slow
def test_labels_are_drawn_and_avoid_overlap():
    labelled = Series(
        name="a", x=[1, 1.01, 5], y=[1, 1, 1], markers=True, labels=["one", "two", ""]
    )
    plain = Series(name="a", x=[1, 1.01, 5], y=[1, 1, 1], markers=True)
    panels = [[Panel(series=[series])] for series in (labelled, plain)]
    assert line_chart(panels[0]) == line_chart(panels[0])
    assert line_chart(panels[0]) != line_chart(panels[1])
    assert _shared((0, 0, 2, 2), (1, 1, 3, 5)) == 1
    assert _shared((0, 0, 2, 2), (2, 0, 3, 5)) == 0
    assert _cost((0, 0, 2, 2), [(0, 0, 1, 1)], (1, 0, 9, 9)) == 1 + 2
