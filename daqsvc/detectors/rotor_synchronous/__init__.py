"""The rotor against its own healthy state: the synchronous vector, revolution by revolution."""
