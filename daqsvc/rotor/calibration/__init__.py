"""What is measured of a rotor: run-ups, Bode plots, and the file that keeps it."""
