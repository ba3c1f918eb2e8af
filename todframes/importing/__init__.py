"""The way from a recording of a chart to a dataset."""
