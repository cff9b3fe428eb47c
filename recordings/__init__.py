"""The recording that the package carries: ``workbench replay sample:scene`` works anywhere."""

from pathlib import Path

SCENE = Path(__file__).with_name("scene.mcap")
