"""One artifact of each kind, for what is told of their differences."""

from __future__ import annotations

from workbench.stage import Artifact

MASK = Artifact("mask", "bool", "H W")
CODES = Artifact("codes", "uint8", "H W")
LABELS = Artifact("labels", "int32", "H W", names_regions=True)
MAP = Artifact("map", "float32", "H W", "mm")
POINTS = Artifact("points", "float32", "N 3")
THING = Artifact("thing")
