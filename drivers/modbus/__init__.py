"""Modbus lines, TCP and RTU."""
