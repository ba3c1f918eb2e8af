"""Charts to record with a camera: on a screen, on paper, and as plates of a black body."""
