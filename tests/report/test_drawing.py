"""Declared plots: whatever the numbers, a figure that shows them and says what it cannot show."""

from __future__ import annotations

import re
import warnings
from typing import Any, get_args
from xml.etree import ElementTree

import numpy as np
import pytest

from mdnum.report import drawing
from mdnum.report.section import Figure, Plot, Region, Role, Series


def plot(*series: Series, x: str = "k", y: str = "loss", **options: Any) -> Plot:
    return Plot("plot", "Awkward", x, y, series, **options)


def awkward() -> dict[str, Plot]:
    """Plots by what is awkward in them."""
    rng = np.random.default_rng(3)
    x = np.linspace(0, 10, 200)
    gaps = np.sin(x)
    gaps[[5, 40, 42]] = np.nan
    gaps[100:140] = np.nan
    decay = np.exp(-3 * x)
    decay[::17] = 0.0
    decay[8::17] *= -1
    long = np.linspace(0, 1, 100_000)
    spike = np.sin(40 * long)
    spike[54_321] = 7.0
    k = 0.5035674359581247 + np.arange(-40, 41) * 2.0**-53
    grid, decades = np.geomspace(0.01, 4, 60), np.geomspace(1e-8, 1, 50)
    region = (np.add.outer(np.log10(grid), 1.5 * np.log10(grid)) > -0.8).astype(int)
    region += (np.add.outer(grid, grid) > 3.2).astype(int)
    words = ("forward and gradient bounded", "forward bounded, gradient overflows", "neither bounded")
    beyond = np.where(x > 8, np.inf, 10 ** (38 * np.minimum(x, 8)))
    return {
        "gaps": plot(Series("height", x, gaps)),
        "zeros on a log axis": plot(
            Series("residual", x, decay, "line+points"), Series("other", x, -decay - 1, "points", "second"),
            y_scale="log",
        ),
        "no series": plot(),
        "all NaN": plot(Series("none", x, x * np.nan), y_scale="symlog"),
        "one point alone": plot(Series("one", np.array([3.0]), np.array([2.0]))),
        "many points": plot(
            Series("line", long, spike), Series("cloud", long, rng.normal(size=100_000), "points", "second"),
            Series("steps", long, np.floor(5 * long), "steps", "third", dashed=True),
        ),
        "infinite": plot(Series("unrolled", x, beyond, "line+points"), y_scale="log"),
        "last digits": plot(
            Series("iterations", k, np.where(k < k[40], 30, 29), "steps"),
            verticals=((float(k[40]), "last with 30 iterations"), (float(k[41]), "first float with 29")),
        ),
        "symlog": plot(
            Series("gradient", decades, np.linspace(-1, 1, 50) ** 9, "line+points"),
            Series("exact", decades, np.full(50, 0.3), role="muted", dashed=True),
            x_scale="log", y_scale="symlog", horizontals=((0.3, "closed form"), (-1e-3, "noise floor")),
        ),
        "map": plot(
            x="h √k", y="damping h", x_scale="log", y_scale="log", region=Region(grid, grid, region, words),
            verticals=((2.0, "h √k = 2"),), horizontals=((0.1, "usual damping"),),
        ),
        "map of one cell": plot(
            region=Region(np.array([0.0]), np.array([1.0]), np.array([[1]]), ("never", "always"))
        ),
        "crowded marks": plot(
            Series("height", x, np.abs(np.cos(x)) * np.exp(-x / 5)),
            verticals=tuple((10 - 8 * 0.6**n, f"bounce {n + 1}") for n in range(9)),
        ),
        "long words": plot(
            *(
                Series(f"a series whose description is number {n} of several rather long ones", x, x + n,
                       role=role)
                for n, role in enumerate(get_args(Role))
            ),
            x="the logarithm of the ratio of the learned stiffness to the one that was asked for (1/s²)",
            y="derivative of the loss with respect to stiffness (m s²)",
        ),
        "small numbers": plot(
            Series("loss", x * 1e-9, x * 1e-12 - 4e-12), Series("other", x * 1e-9, x * 0)
        ),
    }  # fmt: skip


PLOTS = awkward()


@pytest.mark.parametrize("name", PLOTS)
def test_awkward_plots_are_drawn_without_a_warning(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = drawing.standalone(drawing.markup(drawing.draw(PLOTS[name]), "figure"))
    ElementTree.fromstring(text)
    assert len(text) < 400_000
    assert "nan" not in re.sub(r"<text.*?</text>", "", text).lower()
    assert set(re.findall(r"#[0-9a-f]{6}\b", text)) <= {*drawing.LIGHT.values(), *drawing.DARK.values()}
    assert PLOTS[name].title in PLOTS[name].alt and "nan" not in PLOTS[name].alt


def lines(*series, **options):
    (axes,) = drawing.draw(plot(*series, **options)).axes
    return axes


def test_a_gap_stays_a_gap_and_a_lone_value_is_seen():
    y = np.array([0, 1, np.nan, 2, np.nan, 3, 4, 5, 6])
    line, alone = lines(Series("s", np.arange(9.0), y)).lines
    assert alone.get_xydata().tolist() == [[3.0, 2.0]] and alone.get_marker() == "o"
    assert np.isnan(line.get_ydata()).sum() == 2


def test_what_a_logarithmic_axis_cannot_show_is_told():
    values = np.array([1.0, 0.0, 1e-3, -1e-3, 1e-6])
    some = plot(Series("loss", np.arange(5), values), y_scale="log")
    assert [re.findall(r"\d+|loss", note) for note in drawing.notes(some)] == [["2", "loss"]]
    assert drawing.draw(some).axes[0].get_yscale() == "log"
    zero = plot(Series("loss", np.arange(5), 0 * values), y_scale="log")
    assert drawing.draw(zero).axes[0].get_yscale() == "linear"
    assert [re.findall("loss|linear", note) for note in drawing.notes(zero)] == [["loss", "linear"]]
    assert [re.findall(r"\d+", note) for note in drawing.notes(PLOTS["infinite"])] == [["40"]]
    assert drawing.notes(Figure("f", "c", "a", lambda figure: None)) == []


def test_values_that_differ_in_their_last_digits_are_shown_as_differences():
    axes = drawing.draw(PLOTS["last digits"]).axes[0]
    assert axes.get_xlabel() == "k − 0.5035674359581247"
    # differences of neighbors are exact, so none of the 81 floats is lost
    assert len(np.unique(axes.lines[0].get_xdata())) == 81
    assert "first float with 29" in axes.texts[0].get_text()


def test_long_lines_keep_their_peaks_and_their_gaps():
    x = np.linspace(0, 1, 100_000)
    y = np.sin(30 * x)
    y[[700, 12_345]] = [9.0, -9.0]
    y[60_000:60_100] = np.nan
    keep = drawing.thin_line(x, y)
    assert len(keep) <= 4 * (drawing.BINS + 4)
    assert {0, 700, 12_345, 59_999, 60_100, 99_999} <= set(keep.tolist())
    assert np.isnan(y[keep]).any()
    # away from the planted peaks the line through what is kept is the line
    drawn = np.interp(x, x[keep], np.nan_to_num(y[keep]))
    inside = np.r_[1_000:12_000, 13_000:59_000, 61_000:100_000]
    assert np.max(np.abs((drawn - y)[inside])) < 1e-2
    circle = np.linspace(0, 2 * np.pi, 10_000)
    assert len(drawing.thin_line(np.cos(circle), np.sin(circle))) > 9_000


def test_many_points_become_few_that_cover_the_same_places():
    x, y = np.random.default_rng(0).normal(size=(2, 100_000))
    keep = drawing.thin_points(x, y)
    assert 300 < len(keep) <= drawing.MARKS
    assert abs(x[keep].max() - x.max()) < 0.5 and abs(y[keep].min() - y.min()) < 0.5
    few = np.array([0.0, np.nan, 2.0])
    assert drawing.thin_points(few, few).tolist() == [0, 2]


def test_a_region_covers_its_cells_and_nothing_else():
    x, y = np.array([1.0, 2.0, 4.0]), np.array([0.0, 1.0, 2.0])
    value = np.array([[0, 1, 1], [0, 1, 1], [0, 0, 1]])
    axes = lines(region=Region(x, y, value, ("fine", "not", "never")), x_scale="log")
    assert axes.get_legend_handles_labels()[1] == ["fine", "not", "never"]
    paths = {color: [] for color in drawing._CLASSES}
    for bars in axes.collections:
        for path in bars.get_paths():
            paths[_hex(bars.get_facecolor()[0])].append(path)
    for row, height in enumerate(y):
        for column, place in enumerate(x):
            inside = [any(p.contains_point((place, height)) for p in paths[c]) for c in drawing._CLASSES[:2]]
            assert inside == [value[row, column] == 0, value[row, column] == 1]
    assert axes.get_xlim() == pytest.approx((2**-0.5, 2**2.5)) and axes.get_ylim() == (-0.5, 2.5)


def _hex(color):
    return "#" + "".join(f"{round(255 * part):02x}" for part in color[:3])


def test_coinciding_series_are_all_seen():
    x = np.arange(5)
    axes = lines(Series("a", x, x), Series("b", x, x, role="second"), Series("c", x, -x, role="bad"))
    first, second, third = (line.get_linewidth() for line in axes.lines)
    assert first > second == third
    # as far apart as the curve is high, though by little of its value
    high = 1000 + x / 100
    first, second = (
        line.get_linewidth() for line in lines(Series("a", x, high), Series("b", x, high + 0.02)).lines
    )
    assert first == second


def test_labels_of_neighboring_marks_do_not_lie_upon_one_another():
    figure = drawing.draw(PLOTS["crowded marks"])
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in figure.axes[0].texts]
    assert len(boxes) >= 5
    for n, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[n + 1 :])
    assert sum(text.get_text().count("bounce") for text in figure.axes[0].texts) == 9


@pytest.mark.parametrize("name", ["long words", "map"])
def test_legends_stay_on_the_figure(name):
    figure = drawing.draw(PLOTS[name])
    figure.draw_without_rendering()
    assert figure.axes[0].get_legend().get_window_extent().x1 <= figure.bbox.x1 + 1


def test_every_color_of_text_can_be_read():
    """Contrast as WCAG 2.1 defines it: 4.5 for text, on the paper and on cards, light and dark."""

    def luminance(color):
        parts = [int(color[at : at + 2], 16) / 255 for at in (1, 3, 5)]
        linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
        return np.dot([0.2126, 0.7152, 0.0722], linear)

    for theme, card in ((drawing.LIGHT, "#f5f6f8"), (drawing.DARK, "#1d232b")):
        for role in set(theme) - {"paper", "grid"}:
            for ground in (theme["paper"], card):
                low, high = sorted((luminance(theme[role]), luminance(ground)))
                assert (high + 0.05) / (low + 0.05) >= 4.5, (role, ground)


@pytest.mark.parametrize(("height", "below"), [(0.9, True), (0.05, False)])
def test_words_stand_where_no_curve_is(height, below):
    """Of a vertical in the free half of the axes, of a horizontal beside them."""
    x = np.linspace(0, 1, 50)
    curve = Series("a", x, np.where(x > 0.3, height, 0.5))
    ends = Series("b", np.array([0.0, 1e-3]), np.array([0.0, 1.0]))
    plot = Plot("p", "t", "x", "y", (curve, ends), verticals=((0.7, "fork"),), horizontals=((0.5, "limit"),))
    axes = drawing.draw(plot).axes[0]
    fork, limit = axes.texts
    assert (fork.get_verticalalignment() == "bottom") is below
    assert limit.xy[0] > 1 and limit.get_horizontalalignment() == "left"
