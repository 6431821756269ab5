"""Trends and alarm events of months, kept on the box."""
