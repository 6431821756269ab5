"""Bus drivers: bytes on a wire to sample blocks."""
