"""Images behind triangles: real scenes, their turns, and datasets of triangles on them."""
