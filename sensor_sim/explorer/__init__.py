"""The explorer: a page on which a sensor's parameters move and its TOD curve follows."""
