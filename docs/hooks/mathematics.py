"""Conversion of equations to MathML when the site is built, so that pages need no script."""

import html
import re

from latex2mathml.converter import convert

INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
DISPLAYED = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def on_page_content(content, page, config, files):
    """Replace LaTeX by MathML."""
    for pattern, display in ((INLINE, "inline"), (DISPLAYED, "block")):
        content = pattern.sub(lambda found, how=display: _mathml(found[1], how), content)
    return content


def _mathml(latex, display):
    return convert(html.unescape(latex).strip(), display=display)
