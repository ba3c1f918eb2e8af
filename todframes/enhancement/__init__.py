"""Image-enhancement algorithms and their comparison through the observer."""
