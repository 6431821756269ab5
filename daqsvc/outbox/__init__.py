"""What must reach the broker waits here, on disk, until the broker has acknowledged it."""
