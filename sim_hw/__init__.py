"""Simulated hardware: plants and recordings turned into bytes on a wire."""
