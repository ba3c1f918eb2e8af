"""Frame files, displays, datasets and the position of the triangle on a frame."""
