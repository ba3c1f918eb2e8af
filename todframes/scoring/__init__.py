"""Datasets through an observer to thresholds, and the naked eye."""
