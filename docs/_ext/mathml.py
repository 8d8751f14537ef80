"""Mathematics as MathML: browsers draw it by themselves, so pages need no script and no network.

`latex2mathml` translates at build time. A formula that it does not know is a warning, and an error with -W.
"""

import re
from html import escape

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.util import logging

_LOG = logging.getLogger(__name__)
# browsers show no other variant of a letter than the letter itself, so a bold one is Unicode's
_BOLD = re.compile(r"\\mathbf\s*(?:\{([A-Za-z])\}|([A-Za-z]))")


def _bold(match: re.Match[str]) -> str:
    letter = match[1] or match[2]
    return chr(0x1D400 + ord(letter) - ord("A") if letter.isupper() else 0x1D41A + ord(letter) - ord("a"))


def _formula(node, display: str) -> str:
    try:
        return convert(_BOLD.sub(_bold, node.astext()), display=display)
    except (
        Exception
    ) as error:  # a formula is a text that its author wrote: whatever the translator raises, say where
        _LOG.warning("latex2mathml cannot read %r: %s", node.astext(), error, location=node)
        return f"<code>{escape(node.astext())}</code>"


def _inline(translator, node):
    translator.body.append(_formula(node, "inline"))
    raise nodes.SkipNode


def _block(translator, node):
    anchors = "".join(f'<span id="{name}"></span>' for name in node.get("ids", ()))
    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    translator.body.append(f'<div class="math-block">{anchors}{_formula(node, "block")}{number}</div>\n')
    raise nodes.SkipNode


def setup(app):
    """Sphinx calls it: mathematics is drawn by the two functions above."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
