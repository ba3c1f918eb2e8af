"""A result as JSON, tables, figures, sentences and one HTML page."""
