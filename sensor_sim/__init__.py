"""Display frames and TOD curves from a sensor's parameters."""
