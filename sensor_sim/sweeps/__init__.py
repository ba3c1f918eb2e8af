"""Thresholds of many designs of a sensor."""
