"""A camera that is described by what its films show."""
