"""A page on which a sensor's parameters move, and its TOD curve with them."""
