"""What several detectors share of the shaft: its proximity probes, its keyphasor, what is wrong with them."""
