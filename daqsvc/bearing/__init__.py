"""Rolling bearings: their model, their kinematics, and what measured vibration says of their state."""
