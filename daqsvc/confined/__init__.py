"""Work on files that may be damaged or hostile, in a process of its own with bounded memory and time."""
