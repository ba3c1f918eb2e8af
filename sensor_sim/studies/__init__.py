"""The sensor model's part of the studies of accuracy and stability."""
