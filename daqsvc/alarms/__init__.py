"""From a diagnosis to exactly one well-behaved alarm: setpoints, states, and who is told what."""
