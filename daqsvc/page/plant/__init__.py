"""The machines of many boxes, as they tell of themselves over a broker."""
