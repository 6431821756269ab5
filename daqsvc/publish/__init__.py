"""Payloads and the way to the MQTT broker."""
