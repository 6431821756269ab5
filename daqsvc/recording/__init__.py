"""Measured recordings: named channels of samples, out of the files that laboratories and loggers write."""
