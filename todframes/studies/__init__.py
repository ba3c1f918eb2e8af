"""Studies of the package itself: accuracy and numerical stability."""
