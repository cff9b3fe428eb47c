"""Recordings from scene files: meshes and piles, ray traced through the bifocal sensor's optics."""
