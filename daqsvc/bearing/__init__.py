"""Rolling bearings: their model, their kinematics, and what measured vibration states of their state."""
