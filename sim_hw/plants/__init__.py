"""Machines that move: equations of motion with their own arithmetic, and the sensors that watch them."""
