"""The experiment: a person answers the trials of a dataset on a calibrated monitor.

Settings, files and the order of trials are here; the page is served by `todframes.experiment.run_experiment`.
"""
