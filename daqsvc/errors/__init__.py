"""The codes of errors: what each means and what to do about it, in one table.

A message ends with its code, e.g. ``... Remedy: correct the path [F01]``. ``daqsvc explain F01`` states the
rest, and ``docs/reference/errors.md`` lists all of them. Each group has a module: `command_line` (C),
`machine_file` (F), `recordings` (R), `buses` (B), `detectors` (D), `alarms` (A), `outputs` (O) and `service`
(S). Whatever raises an error imports its code from there.
"""
