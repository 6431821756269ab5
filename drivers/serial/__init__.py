"""Serial ports with binary frames or lines of text."""
