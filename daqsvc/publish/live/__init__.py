"""Machines told to who looks on from elsewhere, over the broker, for as long as they look."""
