"""The machines of many boxes, as they report themselves over a broker."""
