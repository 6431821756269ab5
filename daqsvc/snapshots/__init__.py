"""Snapshots: what a machine's box measured and stated around an alarm, in one file that other tools read."""
