"""Observers held against published thresholds of people for other tasks than triangles."""
