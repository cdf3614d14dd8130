"""A person shows a task, or a better way, with the keyboard: the path becomes a demonstration, or a correction."""

from typing import Literal

from pydantic import Field

from koopdqn.demonstrations.generate import DemonstrationSettings
from koopdqn.oracles.terminal.device import Graphics
from koopdqn.settings import Settings


class KeyboardSettings(Settings):
    """How keys move the arm."""

    step_m: float = Field(ge=1e-4, le=0.1, description="what one key moves the flange to begin with [m]")
    turn_rad: float = Field(ge=1e-3, le=0.8, description="what one key turns the tool to begin with [rad]")
    rounding_m: float = Field(
        ge=0, le=0.1, description="over how much of the path its corners are rounded off, 0 for not at all [m]"
    )
    graphics: Graphics = Field(description="how the picture is drawn")


class DemoSettings(DemonstrationSettings):
    """How demonstrations come about."""

    source: Literal["scripted", "keyboard"] = Field(description="who demonstrates: the task's own script, or a person")
    keyboard: KeyboardSettings
