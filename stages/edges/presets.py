"""The presets of the segmentation: where each differs from the default parameters, by stage."""

from __future__ import annotations

from typing import Any

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "paper": {
        "edge_stack": {
            "operator": "gef", "noise_units": False, "lowest": 1.0, "max_ratio": 0.05,
            "use_depth": False,
        },
        "linked_edges": {
            "min_weight": 0.0, "use_evidence": False, "corners": 0.0, "use_depth": False,
        },
        "region_features": {},
    },
    "default": {"edge_stack": {}, "linked_edges": {}, "region_features": {}},
}  # fmt: skip
