"""Detectors: they read rings, run compiled kernels off the event loop, and say what they found."""
