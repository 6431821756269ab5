"""Snapshots: what a machine's box saw and said around an alarm, in one file that other tools read."""
