"""From regions to named parts and poses (paper, 5 and 6): pure mathematics on numpy arrays."""
