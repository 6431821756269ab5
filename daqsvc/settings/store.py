"""Where state lives that must survive a restart."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003 - pydantic needs it at run time
from typing import Annotated

from pydantic import Field

from daqsvc.settings.section import Section


class Store(Section):
    """Where state lives that must survive a restart."""

    directory: Annotated[
        Path, Field(strict=False, description="directory of the journal", examples=["/var/lib/daqsvc"])
    ]
