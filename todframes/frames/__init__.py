"""Frame files, displays, datasets, and where the triangle lies on a frame."""
