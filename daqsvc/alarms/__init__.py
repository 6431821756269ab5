"""From diagnoses to alarms: setpoints, states, and exactly one event for each change."""
