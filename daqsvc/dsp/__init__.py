"""Signal processing that knows shafts and sensors, but no machine and no fault."""
