"""Declared plots: whatever the numbers, a figure that shows them and says what it cannot show."""

from __future__ import annotations

import re
import warnings
from xml.etree import ElementTree

import numpy as np
import pytest
from report.synthetic_demos import awkward

from mdnum.ball.demos.base import Plot, Region, Series
from mdnum.report import plots, svg, thin
from mdnum.report.axes import PAGE_WIDTH, PHONE_WIDTH
from mdnum.report.scales import Scale

PLOTS = awkward()


def texts(figure) -> str:
    markup = svg.markup(figure, "figure")
    return " | ".join(re.findall(r"<text[^>]*>([^<]*)</text>", markup))


@pytest.mark.parametrize("name", PLOTS)
@pytest.mark.parametrize("width", [PAGE_WIDTH, PHONE_WIDTH])
def test_awkward_plots_are_drawn_without_a_warning(name, width):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = svg.standalone(svg.markup(plots.draw(PLOTS[name], width), "figure"))
    ElementTree.fromstring(text)
    assert len(text) < 400_000
    assert "nan" not in re.sub(r"<text.*?</text>", "", text).lower()
    assert set(re.findall(r"#[0-9a-f]{6}\b", text)) <= {*svg.LIGHT.values(), *svg.DARK.values()}


def test_a_gap_stays_a_gap_and_a_lone_value_is_seen():
    x = np.arange(9.0)
    y = np.array([0, 1, np.nan, 2, np.nan, 3, 4, 5, 6])
    (axes,) = plots.draw(Plot("t", "x", "y", (Series("s", x, y),))).axes
    alone, line = axes.lines
    assert alone.get_xydata().tolist() == [[3.0, 2.0]] and alone.get_marker() == "o"
    assert np.isnan(line.get_ydata()).sum() == 2


def test_what_a_logarithmic_axis_cannot_show_is_marked_and_told():
    y = np.array([1.0, 0.0, 1e-3, -1e-3, 1e-6])
    plot = Plot("t", "step", "loss", (Series("loss", np.arange(5), y),), y_scale="log")
    (axes,) = plots.draw(plot).axes
    marks = [line for line in axes.lines if line.get_marker() == "v"]
    assert [line.get_xdata().tolist() for line in marks] == [[1, 3]]
    assert plots.notes(plot) == ["2 values of “loss” are zero or negative: ▿ at the lower edge."]
    assert axes.get_yscale() == "log"
    zero = Plot("t", "step", "loss", (Series("loss", np.arange(5), 0 * y),), y_scale="log")
    assert plots.draw(zero).axes[0].get_yscale() == "linear"
    assert plots.notes(zero) == ["No value of loss is positive, so its axis is linear."]
    assert plots.notes(PLOTS["infinite"]) == ["40 values are infinite and left out."]


def test_values_that_differ_in_their_last_digits_are_shown_as_differences():
    figure = plots.draw(PLOTS["last digits"])
    assert figure.axes[0].get_xlabel() == "k − 0.5035674359581247 (10⁻¹⁵)"
    line = max(figure.axes[0].lines, key=lambda line: len(line.get_xdata()))
    # differences of neighbors are exact, so none of the 81 floats is lost
    assert len(np.unique(line.get_xdata())) == 81
    assert "last float with 30 iterations" in texts(figure)
    assert Scale.choose("linear", [np.array([1.0, 1.1])]).shift == 0
    assert Scale.choose("linear", [np.array([2.0, 2.0])]).shift == 0


def test_long_lines_keep_their_peaks_and_their_gaps():
    x = np.linspace(0, 1, 100_000)
    y = np.sin(30 * x)
    y[[700, 12_345]] = [9.0, -9.0]
    y[60_000:60_100] = np.nan
    keep = thin.line(x, y)
    assert len(keep) <= 4 * (thin.BINS + 4)
    assert {0, 700, 12_345, 59_999, 60_100, 99_999} <= set(keep.tolist())
    assert np.isnan(y[keep]).any()
    # away from the planted peaks the line through what is kept is the line
    drawn = np.interp(x, x[keep], np.nan_to_num(y[keep]))
    inside = np.r_[1_000:12_000, 13_000:59_000, 61_000:100_000]
    assert np.max(np.abs((drawn - y)[inside])) < 1e-2
    assert thin.line(x[:100], y[:100]).tolist() == list(range(100))
    circle = np.linspace(0, 2 * np.pi, 10_000)
    assert len(thin.line(np.cos(circle), np.sin(circle))) > 9_000


def test_many_points_become_few_that_cover_the_same_places():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 100_000))
    keep = thin.points(x, y)
    assert 300 < len(keep) <= thin.MARKS
    assert abs(x[keep].max() - x.max()) < 0.5 and abs(y[keep].min() - y.min()) < 0.5
    few = np.array([0.0, np.nan, 2.0])
    assert thin.points(few, few).tolist() == [0, 2]


def test_a_region_covers_its_cells_and_nothing_else():
    x, y = np.array([1.0, 2.0, 4.0]), np.array([0.0, 1.0, 2.0])
    value = np.array([[0, 1, 1], [0, 1, 1], [0, 0, 1]])
    plot = Plot("t", "x", "y", region=Region(x, y, value, ("fine", "not", "never")), x_scale="log")
    (axes,) = plots.draw(plot).axes
    assert [patch.get_label() for patch in axes.patches] == ["fine", "not"]
    for row, height in enumerate(y):
        for column, place in enumerate(x):
            inside = [patch.get_path().contains_point((place, height)) for patch in axes.patches]
            assert inside == [value[row, column] == 0, value[row, column] == 1]
    assert axes.get_xlim() == pytest.approx((2**-0.5, 2**2.5))
    assert axes.get_ylim() == (-0.5, 2.5)


def test_coinciding_series_are_drawn_one_upon_the_other():
    widths = {line.get_label(): line.get_linewidth() for line in plots.draw(PLOTS["hidden"]).axes[0].lines}
    first, second, third = widths.values()
    assert first > second > third


def test_labels_of_neighboring_marks_do_not_lie_upon_one_another():
    figure = plots.draw(PLOTS["crowded marks"])
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in figure.axes[0].texts]
    assert len(boxes) >= 5
    for n, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[n + 1 :])


def test_legends_and_labels_stay_on_a_phone():
    for name in ("long words", "hidden", "map"):
        figure = plots.draw(PLOTS[name], PHONE_WIDTH)
        figure.draw_without_rendering()
        box = figure.axes[0].get_legend().get_window_extent()
        assert box.x1 <= figure.bbox.x1 + 1, name
