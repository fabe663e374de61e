"""What keeps foreign code from the results: its own random numbers, and a watch on the networks and on the code that measures."""
