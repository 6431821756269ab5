"""How Sphinx makes the site of the documentation: ``make docs``.

Pages are plain Markdown that reads as well on a forge. What the site needs beyond that is in site_pages.py,
and its search in site_search.py.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, f"{HERE}")

project = "daqsvc"
author = "daqsvc developers"
[release] = re.findall('__version__ = "(.+)"', (HERE.parent / "daqsvc/__init__.py").read_text("utf-8"))
version = release

extensions = ["myst_parser", "site_pages", "site_search"]
root_doc = "index"
exclude_patterns = ["example_*"]
highlight_language = "text"

# An option that is copied from a page begins with two hyphens, and quotes are those of TOML.
smartquotes = False

# Anchors are those that a forge makes of headings.
myst_heading_anchors = 5

html_theme = "furo"
html_favicon = "favicon.svg"
html_static_path = ["site_static"]
html_title = f"daqsvc {release}"
# The same sources make the same files: no times, no copies of the sources.
html_last_updated_fmt = None
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
html_show_sphinx = False
