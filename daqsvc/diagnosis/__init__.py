"""Detectors: they read rings, run compiled kernels off the event loop, and state what they found."""
