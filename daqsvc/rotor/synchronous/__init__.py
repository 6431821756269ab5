"""The rotor by its synchronous vector: five complex numbers a revolution, and what their change means."""
