"""`daqsvc demo`: the whole service against a simulated machine, in one process."""
