"""Depth from defocus: the mathematics of section 3, on numpy arrays alone."""
