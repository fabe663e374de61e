"""The highway world: a batched engine with results identical to highway-env."""
