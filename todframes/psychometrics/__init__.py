"""Psychometric functions: fits, intervals, paired comparisons."""
