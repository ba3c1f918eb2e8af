"""Diagnosis: the triangle that frames show, against what their dataset says, and the words for the difference.

It measures frames, finds triangles, warns about frames that go wrong, and explains missing thresholds.
"""
