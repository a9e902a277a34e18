"""Formulas as MathML, made by the build: browsers draw them without a script or a network."""

import html
import re

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.util.logging import getLogger

_LOGGER = getLogger(__name__)


def mathml(text, *, block=False):
    r"""Return the MathML of a formula in TeX; lines are parted by ``\\`` and aligned at ``&``."""
    if block and r"\\" in text and r"\begin" not in text:
        text = rf"\begin{{split}}{text}\end{{split}}"
    markup = convert(text, display="block" if block else "inline")
    if unknown := re.search(r">(\\[^<]*|&)<", markup):
        raise ValueError(f"unknown command {unknown[1]}")
    return markup.replace("<math ", f'<math alttext="{html.escape(text.strip())}" ', 1)


def _written(writer, node, *, block):
    try:
        markup = mathml(node.astext(), block=block)
    except Exception as error:  # whatever the converter raises, the page has a formula less
        _LOGGER.warning("formula %r: %s", node.astext(), error, location=node)
        markup = ""
    tag = "div" if block else "span"
    writer.body.append(f'<{tag} class="math">{markup}</{tag}>')
    raise nodes.SkipNode


def setup(app):
    """Sphinx calls this."""
    inline, block = (lambda w, n, b=b: _written(w, n, block=b) for b in (False, True))
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
