"""Sweeps: a grid of parameters over recordings, each distinct result computed once and kept."""
