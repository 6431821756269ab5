"""The box as an edge node of Sparkplug B 3.0, beside its own topics."""
