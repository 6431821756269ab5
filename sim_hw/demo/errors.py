"""Why the demo cannot run."""

from __future__ import annotations


class DemoError(Exception):
    """The demo cannot run; the message says why and what to do."""
