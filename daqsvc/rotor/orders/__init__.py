"""1X without a phase reference: accelerometers against a healthy run."""
