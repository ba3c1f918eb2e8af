"""Charts to record with a camera, recordings, and the way from them to datasets."""
