"""Displays: from code values to luminance and back."""
