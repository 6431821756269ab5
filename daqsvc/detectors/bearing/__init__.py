"""Rolling bearings: the lines of their kinematics, and the change against the healthy machine."""
