"""The broker: alarms, diagnoses and status to it, commands from it."""
