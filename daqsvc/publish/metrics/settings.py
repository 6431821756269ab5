"""Where metrics are served."""

from __future__ import annotations

from pydantic import Field

from daqsvc.settings.addresses import ListenAddress  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import Section

DEFAULT = "127.0.0.1:9464"


class Metrics(Section):
    """Metrics for Prometheus, and a health endpoint."""

    listen: ListenAddress = Field(
        default=DEFAULT, description="host and TCP port at which /metrics and /healthz are served"
    )
