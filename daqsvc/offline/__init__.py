"""Recordings: the detectors of the service over files, from a machine file or options to a verdict."""
