"""What Home Assistant gets, and how often."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from daqsvc.settings.section import Section


class HomeAssistant(Section):
    """Home Assistant's discovery: the machine shows up there by itself."""

    enabled: bool = Field(
        default=True, description="false removes what was announced to Home Assistant before"
    )
    prefix: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$", max_length=256)] = Field(
        default="homeassistant", description="discovery prefix of Home Assistant"
    )
    every_s: Annotated[float, Field(ge=10, le=3600)] = Field(
        default=60.0, description="how often figures are sent that do not change"
    )
    deadband_percent: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=10.0, description="change by which a figure is sent before its time, every 10 s at most"
    )
