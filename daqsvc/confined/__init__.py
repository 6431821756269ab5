"""Work on files that may be damaged or hostile, in a separate process with bounded memory and time."""
