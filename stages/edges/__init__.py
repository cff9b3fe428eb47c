"""From edges to closed regions: the mathematics of sections 4 and 5, on numpy arrays alone."""
