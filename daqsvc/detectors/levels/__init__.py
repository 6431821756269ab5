"""Levels of vibration, window by window, and values that the device measures itself."""
