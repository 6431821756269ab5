"""daqsvc: acquisition and model-based fault diagnosis for rotating machines."""

__version__ = "0.1.0"
