"""The rotor's model bank: one observer per mode, after Loparo et al. 2000."""
