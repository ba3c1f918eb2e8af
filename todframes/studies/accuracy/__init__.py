"""Error against run time of several ways to compute a threshold."""
