"""The rotor that loses its damping until it rubs: figures 4 to 7 of the paper."""
