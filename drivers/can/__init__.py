"""CAN and CAN FD buses."""
