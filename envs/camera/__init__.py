"""The camera world: an approach to a stop sign, rendered once by a path tracer and replayed with any texture on the sign."""
