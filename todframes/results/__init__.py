"""Results of commands, with their tables, figures, sentences and HTML page."""
