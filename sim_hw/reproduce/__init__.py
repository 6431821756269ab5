"""The paper's experiments from scratch: its figures, and what it states against what comes out."""
