"""The world `platoon`: cars behind each other that tell each other by radio how they move."""
