"""Reports on the terminal: of a run, and of the ranking."""
