"""What a bank can tell apart, before any fault happens."""
