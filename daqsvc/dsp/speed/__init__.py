"""The speed and the angle of a shaft: by a keyphasor, by an orbit, by the harmonics in a spectrum."""
