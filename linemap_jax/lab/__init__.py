"""Experiments on top of the core: what a map is worth."""
