"""The page in a browser, started beside the service."""
