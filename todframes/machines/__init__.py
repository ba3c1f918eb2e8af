"""Machines that look: neural networks in files as observers."""
