"""Metrics for Prometheus, and whether the service is healthy, over HTTP."""
