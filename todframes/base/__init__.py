"""Reading of settings, output folders, remote files, errors and other things that every room needs."""
