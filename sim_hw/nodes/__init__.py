"""Devices on a bus: what samples a machine, puts the samples into frames and sends them in time."""
