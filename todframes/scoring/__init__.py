"""The scoring of datasets by an observer to obtain thresholds, and thresholds of the naked eye."""
