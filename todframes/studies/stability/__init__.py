"""Extreme inputs: the expected value, the computed value, and the number of right digits."""
