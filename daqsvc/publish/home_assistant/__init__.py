"""Home Assistant, over the connection to the broker: the machine shows up there by itself."""
