"""Recordings: readers of what cameras write, and the measurement of noise and MTF in them."""
