"""``daqsvc new``: a first machine file, by a few questions."""
