"""Recordings, played as if they came over a bus."""
