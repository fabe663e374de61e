"""Recorded traffic: a reader of CommonRoad scenes, and the world that drives on them."""
