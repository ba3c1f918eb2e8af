"""Conditions side by side: cameras, displays, algorithms, and curves of sensors."""
