"""From a curve of thresholds to the field: targets, air, and the range at which a person can do a task."""
