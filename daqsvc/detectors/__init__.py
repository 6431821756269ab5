"""The detectors: one folder each, with settings, checks, description and what builds the detector."""
