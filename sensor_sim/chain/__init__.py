"""The stages of a sensor, from the scene to the displayed frame."""
