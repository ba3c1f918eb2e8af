"""Thresholds of a sensor by computation."""
