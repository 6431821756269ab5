"""The site of the documentation under ``/docs/`` of the page, as ``make docs`` has made it."""

from __future__ import annotations

import re
from base64 import b64encode
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

from starlette.staticfiles import StaticFiles

import daqsvc

if TYPE_CHECKING:
    import os

    from starlette.responses import Response
    from starlette.types import Scope

PLACES = (
    Path(daqsvc.__file__).parents[1] / "build" / "docs" / "html",  # a tree of sources
    Path("/usr/share/doc/daqsvc/html"),  # the Debian package
)
WHY_NOT = (
    "the documentation is not on this box: the Debian package brings it, and in a tree of the sources "
    "make docs makes it; then start the page again"
)
_SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL)


def built_site() -> Path | None:
    """The folder of the site; None if there is none."""
    return next((place for place in PLACES if (place / "index.html").is_file()), None)


class Documentation(StaticFiles):
    """The files of the site, with the policy that they need.

    Args:
        folder: of the site; each of its pages has the inline scripts of its index.html, or fewer.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder, html=True)
        scripts = _SCRIPT.findall((folder / "index.html").read_text("utf-8"))
        hashes = [f" 'sha256-{b64encode(sha256(script.encode()).digest()).decode()}'" for script in scripts]
        self._policy = (
            f"default-src 'none'; script-src 'self'{''.join(hashes)}; style-src 'self' 'unsafe-inline'; "
            "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'self'; "
            "frame-ancestors 'none'"
        )

    def file_response(
        self,
        full_path: str | os.PathLike[str],
        stat_result: os.stat_result,
        scope: Scope,
        status_code: int = 200,
    ) -> Response:
        """See Starlette."""
        response = super().file_response(full_path, stat_result, scope, status_code)
        response.headers["content-security-policy"] = self._policy
        response.headers["cache-control"] = "no-cache"  # asked for again each time, sent if it has changed
        return response
