"""Limits of a sensor: the light, aperture, noise or range at which a triangle is just recognised."""
