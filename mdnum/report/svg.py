"""matplotlib figures as SVG that follows the page: its font, its colors, light and dark."""

from __future__ import annotations

import io
import re
from contextlib import AbstractContextManager
from html import escape

import matplotlib as mpl
from matplotlib.figure import Figure

# colors that stand for a role; no figure uses them otherwise, so they can be replaced in the finished file
INK, MUTED, GRID, FIRST, SECOND, THIRD, BAD, PAPER = (f"#0102{index:02x}" for index in range(1, 9))
_ROLES = {
    INK: "ink",
    MUTED: "muted",
    GRID: "grid",
    FIRST: "first",
    SECOND: "second",
    THIRD: "third",
    BAD: "bad",
    PAPER: "paper",
}

#: gid of text that stands on lines: it gets a rim in the color of the paper.
HALO = "halo"
_RIM = "paint-order: stroke; stroke: var(--paper); stroke-width: 3px; stroke-linejoin: round;"

LIGHT = {
    "ink": "#1c2430", "muted": "#66707e", "grid": "#e3e6ea", "first": "#2563a8", "second": "#ad5712",
    "third": "#2c7a63", "bad": "#b3261e", "paper": "#ffffff",
}  # fmt: skip
DARK = {
    "ink": "#e4e7ec", "muted": "#98a2b0", "grid": "#2b323c", "first": "#74a9e8", "second": "#e79a58",
    "third": "#63bda1", "bad": "#f07b72", "paper": "#14181e",
}  # fmt: skip
FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", "Helvetica Neue", Arial, sans-serif'


def style() -> AbstractContextManager[None]:
    """The settings under which figures are drawn, whatever the user's matplotlibrc says."""
    return mpl.rc_context(
        {
            **mpl.rcParamsDefault,
            "backend": mpl.get_backend(),
            "font.family": "DejaVu Sans",
            "font.size": 9,
            "axes.labelsize": 9,
            "axes.edgecolor": MUTED,
            "axes.linewidth": 0.7,
            "axes.labelcolor": INK,
            "text.color": INK,
            "xtick.color": MUTED,
            "ytick.color": MUTED,
            "xtick.labelcolor": INK,
            "ytick.labelcolor": INK,
            "xtick.labelsize": 8.5,
            "ytick.labelsize": 8.5,
            "axes.unicode_minus": True,
            "axes.formatter.useoffset": False,
            "figure.facecolor": "none",
            "axes.facecolor": "none",
            "savefig.facecolor": "none",
            "path.simplify_threshold": 0.3,
            "svg.fonttype": "none",
        }
    )


def markup(figure: Figure, name: str) -> str:
    """A figure as an <svg> element whose colors are roles.

    Args:
        name: makes the element's ids unique on a page.
    """
    sink = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(sink, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = sink.getvalue()
    text = text[text.index("<svg ") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    for color, role in _ROLES.items():
        text = text.replace(color, f"var(--{role})")
    # the page's own font instead of the one it was measured with
    text = text.replace("font-family: 'DejaVu Sans'; ", "")
    text = text.replace(f' id="{HALO}"', f' class="{HALO}"')
    text = re.sub(r' transform="rotate\(-0 [^)]*\)"', "", text)
    referenced = set(re.findall(r"#([\w.-]+)", text))
    text = re.sub(r' id="([^"]+)"', lambda found: found[0] if found[1] in referenced else "", text)
    text = re.sub(r'id="([^"]+)"', rf'id="{name}-\1"', text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{name}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", text)
    # a hundredth of a point is finer than any screen; what stands between the tags are the labels
    text = re.sub(r"<[^>]+>", lambda tag: re.sub(r"(\d+\.\d{2})\d+", r"\1", tag[0]), text)
    return re.sub(r"\n\s*\n*", "\n", text)


def inline(text: str, title: str) -> str:
    """An <svg> element for an HTML page that defines the colors as custom properties.

    Args:
        text: what `markup` gave.
        title: what a screen reader says.
    """
    text = re.sub(r'<svg [^>]*?viewBox="([^"]+)"[^>]*>', r'<svg viewBox="\1" role="img">', text, count=1)
    return text.replace('role="img">', f'role="img" aria-label="{escape(title)}">', 1)


def standalone(text: str) -> str:
    """A whole SVG file, which carries both sets of colors and follows the viewer's preference.

    Args:
        text: what `markup` gave.
    """
    rules = (
        f"svg {{ {_properties(LIGHT)} }} "
        f"@media (prefers-color-scheme: dark) {{ svg {{ {_properties(DARK)} }} }} "
        f"text {{ font-family: {FONT}; }} .{HALO} text {{ {_RIM} }}"
    )
    return re.sub(r"(<svg [^>]*>)", rf"\1<style>{rules}</style>", text, count=1)


def _properties(colors: dict[str, str]) -> str:
    return " ".join(f"--{role}: {color};" for role, color in colors.items())
