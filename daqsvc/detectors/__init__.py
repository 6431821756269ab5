"""The detectors: one folder each, with settings, checks, description and what makes the detector of them."""
