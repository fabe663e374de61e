"""The camera world: an approach to a stop sign, path-traced once and replayed with any texture on the sign."""
