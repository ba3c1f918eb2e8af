"""Limits of a sensor: the light, aperture or noise at which a triangle is just judged."""
