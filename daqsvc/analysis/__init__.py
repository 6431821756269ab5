"""Recordings under the detectors of the service: from a recording and what is known about it to a verdict."""
