"""From decoded frames to gap-accounted blocks on a true time base, kept in a ring.

Everything here knows samples, counters and clocks, and nothing of machines, faults or alarms.
"""
