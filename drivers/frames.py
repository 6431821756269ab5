"""Frame layouts: where the counter and the samples lie in a payload, for encoding and decoding alike.

A `FrameLayout` is compiled once into NumPy gather indices; a batch of frames is then decoded or
encoded by a handful of array operations, however many samples it holds. The virtual bus encodes with
the same object that the driver decodes with.
"""
