"""The optics of the bifocal sensor and its projector: rig, thin lens, analytic images."""
