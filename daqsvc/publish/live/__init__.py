"""Live data of machines, over the broker, to viewers that ask for it."""
