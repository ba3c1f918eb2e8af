"""Reading of settings, output folders, errors and other things that every room needs."""
