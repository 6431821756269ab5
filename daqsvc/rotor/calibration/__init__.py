"""What a rotor says of itself: run-ups, Bode plots, and the file that keeps it."""
