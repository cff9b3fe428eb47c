"""The live page: a recording's stages with their parameters beside the viewer.

``live`` holds the state and recomputes (no page, no Rerun); ``canvas`` draws into Rerun; ``page``
makes the widgets; ``server`` serves both on loopback.
"""
