"""The views of a machine, each a module: its figures, and what goes into them."""
