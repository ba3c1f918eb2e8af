"""Frame files, datasets of frames, and their contrast against the background."""
