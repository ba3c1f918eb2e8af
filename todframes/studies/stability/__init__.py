"""Extreme inputs: what is expected, what came, digits kept."""
