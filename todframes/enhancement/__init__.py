"""Image-enhancement algorithms, and datasets scored after them."""
