"""Datasets of simulated frames."""
