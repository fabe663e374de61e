"""CARLA as a second camera world: the same approaches, seen by CARLA's camera, for scoring patches crafted elsewhere."""
